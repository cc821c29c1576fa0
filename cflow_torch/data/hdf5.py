"""OpenSceneFlow's HDF5 scenes: one file per scene, one group per sweep, named by its time stamp."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any, List, Optional, Sequence, Type, Union

import numpy as np

from cflow_torch.data.log import FlowLabels
from cflow_torch.types import CFlowError, Sweep

# Time stamps count from 1970 or 1980: below this they are microseconds (16 digits), above it nanoseconds (18 or 19).
_FIRST_NANOSECOND = 10**17


def find_hdf5_scenes(root: Union[str, Path]) -> List[Path]:
    """The scene files of a folder, or the one file given, sorted.

    Raises:
        CFlowError: `root` does not exist.
    """
    root = Path(root)
    if root.is_file():
        return [root]
    if not root.is_dir():
        raise CFlowError(f"{root} is neither a file nor a folder; give a scene (.h5) or a folder of scenes")
    return sorted(root.glob("*.h5"))


class HDF5Log:
    """One scene; implements the `Log` protocol. Needs h5py (`pip install 'cflow_torch[hdf5]'`).

    Args:
        file: `<scene>.h5`.

    Attributes:
        log_id: file name without its ending.
        timestamps: names of the groups as integers, ascending, in nanoseconds or microseconds as the data set has
            them; the sweeps' `timestamp_ns` are nanoseconds.

    Convention:
        The group's `lidar` lies in the frame that the file was written in (for Argoverse 2 files that is the up_lidar
        sensor, while `pose` is the ego vehicle's). The index files beside a scene are pickles and are never read.

    Raises:
        CFlowError: h5py is missing, the file is no HDF5 file, or it holds fewer than two sweeps.
    """

    def __init__(self, file: Union[str, Path]) -> None:
        try:
            import h5py
        except ImportError:
            raise CFlowError("reading HDF5 scenes needs h5py: pip install 'cflow_torch[hdf5]'") from None
        self.file = Path(file)
        self.log_id = self.file.stem
        try:
            self._scene = h5py.File(self.file, "r")
        except OSError as error:
            raise CFlowError(f"{self.file} cannot be read as HDF5 ({error}): give a scene that is complete") from error
        self.timestamps: Sequence[int] = sorted(int(name) for name in self._scene if name.isdigit())
        if len(self.timestamps) < 2:
            self._scene.close()
            raise CFlowError(f"{self.file} has {len(self.timestamps)} sweeps; scene flow needs two or more")

    def __enter__(self) -> HDF5Log:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self._scene.close()

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`: float32 points, float64 pose, ground mask where the scene has one.

        Raises:
            CFlowError: no such sweep, or `lidar` or `pose` is missing or cannot be read.
        """
        timestamp = self._timestamp(index)
        points = self._read(timestamp, "lidar").astype(np.float32, copy=False)
        if points.ndim != 2 or points.shape[1] < 3:
            raise CFlowError(f"{self.file}: lidar of sweep {timestamp} has shape {points.shape}, expected (N, 3+)")
        is_ground = self._column(timestamp, "ground_mask", np.bool_, len(points))
        pose = self._read(timestamp, "pose").astype(np.float64)
        nanoseconds = timestamp if timestamp >= _FIRST_NANOSECOND else timestamp * 1000
        return Sweep(points[:, :3], is_ground, pose, nanoseconds)

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1); None where the sweep has no `flow`.

        Raises:
            CFlowError: no such sweep, or its labels cannot be read.
        """
        timestamp = self._timestamp(index)
        if "flow" not in self._scene[str(timestamp)]:
            return None
        flow = self._read(timestamp, "flow").astype(np.float32, copy=False)
        category = self._column(timestamp, "flow_category_indices", np.uint8, len(flow))
        is_valid = self._column(timestamp, "flow_is_valid", np.bool_, len(flow))
        if category is None or is_valid is None:
            raise CFlowError(f"{self.file}: sweep {timestamp} has flow without flow_category_indices or flow_is_valid")
        return FlowLabels(flow, category, is_valid)

    def eval_mask(self, index: int) -> Optional[np.ndarray]:
        """(N,) bool points to score, None where the sweep has no `eval_mask`."""
        timestamp = self._timestamp(index)
        return self._column(timestamp, "eval_mask", np.bool_, len(self._scene[str(timestamp)]["lidar"]))

    def _timestamp(self, index: int) -> int:
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"scene {self.log_id} has {len(self.timestamps)} sweeps, there is no sweep {index}")
        return self.timestamps[index]

    def _read(self, timestamp: int, key: str) -> np.ndarray:
        try:
            return np.asarray(self._scene[str(timestamp)][key][()])
        except (KeyError, OSError, TypeError, AttributeError) as error:
            raise CFlowError(f"{self.file}: cannot read {key} of sweep {timestamp} ({error})") from error

    def _column(self, timestamp: int, key: str, dtype: Any, rows: int) -> Optional[np.ndarray]:
        """(N,) values of a key, also where it is stored as (N, 1); None where it is absent."""
        if key not in self._scene[str(timestamp)]:
            return None
        values = self._read(timestamp, key)
        if values.shape not in ((rows,), (rows, 1)):
            raise CFlowError(f"{self.file}: {key} of sweep {timestamp} has shape {values.shape}, expected ({rows},)")
        return values.reshape(rows).astype(dtype, copy=False)
