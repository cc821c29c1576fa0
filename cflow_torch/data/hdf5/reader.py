"""OpenSceneFlow's HDF5 scenes: one file per scene, one group per sweep, named by its time stamp."""

from __future__ import annotations

import weakref
from pathlib import Path
from types import TracebackType
from typing import Any, List, Optional, Sequence, Tuple, Type

import numpy as np

from cflow_torch.data.hdf5.chunks import Stored
from cflow_torch.data.hdf5.contained import Group, array, check_numbers, group, hdf5_errors, names, read
from cflow_torch.data.hdf5.frames import StoredMotion, harness_motion, is_argoverse2, recognized_extrinsics
from cflow_torch.data.hdf5.index_file import read_index
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.paths import Place, as_path, is_remote, ranged
from cflow_torch.types import CFlowError, Sweep
from cflow_torch.windows.ego_motion import rigid_transform

# Time stamps count from 1970 or 1980: below this they are microseconds (16 digits), above it nanoseconds (18 or 19).
_FIRST_NANOSECOND = 10**17
_LAST = 2**63 - 1  # what 64 bits hold
_LARGEST_CATEGORY = 255
EXTRINSIC = "ego_T_lidar"  # attribute of a scene that `write_hdf5_scene` leaves


def find_hdf5_scenes(root: Place) -> List[Path]:
    """The scene files of a folder, or the one file given, sorted.

    Raises:
        CFlowError: `root` does not exist.
    """
    root = as_path(root)
    if root.is_file():
        return [root]
    if not root.is_dir():
        raise CFlowError(f"{root} is neither a file nor a folder; give a scene (.h5) or a folder of scenes")
    return sorted(root.glob("*.h5"))


class HDF5Log:
    """One scene; implements the `Log` protocol. Needs h5py (`pip install h5py`).

    Args:
        file: `<scene>.h5`.
        ego_T_lidar: (4, 4), coordinates of the stored points to the frame whose poses are stored; None = the same
            frame; "auto" = as the scene says (see Convention).

    Attributes:
        log_id: file name without its ending.
        timestamps: names of the groups as integers, ascending, in nanoseconds or microseconds as the data set has
            them; the sweeps' `timestamp_ns` are nanoseconds.
        ego_T_lidar: (4, 4) float64, the one in use.

    Convention:
        - Points, labels and results stay in the frame of the file, that of the LiDAR. A sweep's `pose` is the LiDAR's:
          the stored pose times `ego_T_lidar`. So the static world stays put also where the file has points in the
          sensor frame and poses of the ego vehicle.
        - "auto": the file's attribute `ego_T_lidar` if it has one (our writer's do), otherwise what the first sweep
          looks like, see `recognized_extrinsics`.
        - Index files beside a scene are pickles; only `eval_frames` reads one, and runs nothing in it.

    Raises:
        CFlowError: h5py is missing, the file is no HDF5 file, it holds fewer than two sweeps, or `ego_T_lidar` is no
            rigid motion.
    """

    def __init__(self, file: Place, ego_T_lidar: Any = "auto") -> None:
        try:
            import h5py
        except ImportError:
            raise CFlowError("reading HDF5 scenes needs h5py: pip install h5py") from None
        self.file = as_path(file)
        self.log_id = self.file.stem
        with hdf5_errors(f"{self.file} cannot be read as HDF5"):
            if not is_remote(self.file) and not self.file.is_file():
                raise FileNotFoundError("no such file, or a folder, pipe or device")  # HDF5 would wait for a pipe
            self._scene = h5py.File(ranged(self.file), "r")
        self._last: Tuple[int, Any] = (-1, None)
        # HDF5 itself closes after the interpreter has gone, which a file read through Python does not survive.
        weakref.finalize(self, self._scene.close)
        try:
            self.timestamps: Sequence[int] = sorted(
                _stamp(name, self.file)
                for name in names(self._scene, str(self.file))
                if name.isascii() and name.isdigit()
            )
            if len(self.timestamps) < 2:
                raise CFlowError(f"{self.file} has {len(self.timestamps)} sweeps; scene flow needs two or more")
            if isinstance(ego_T_lidar, str) and ego_T_lidar == "auto":
                ego_T_lidar = self._stated_extrinsics()
            elif ego_T_lidar is None:
                ego_T_lidar = np.eye(4)
            self.ego_T_lidar = rigid_transform(ego_T_lidar, f"ego_T_lidar of {self.file}")
        except BaseException:
            self._scene.close()
            raise

    def __enter__(self) -> HDF5Log:
        return self

    def __exit__(
        self, kind: Optional[Type[BaseException]], error: Optional[BaseException], trace: Optional[TracebackType]
    ) -> None:
        self._scene.close()

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`: float32 points, float64 pose of their frame, ground mask where the scene has one.

        Raises:
            CFlowError: no such sweep, or `lidar` or `pose` is missing or cannot be read.
        """
        timestamp = self._timestamp(index)
        points = self._values(timestamp, "lidar", self._lidar(timestamp), np.float32)
        is_ground = self._column(timestamp, "ground_mask", len(points), np.bool_)
        pose = self._pose(timestamp).astype(np.float64)
        if not np.array_equal(self.ego_T_lidar, np.eye(4)):
            pose = rigid_transform(pose, f"pose of sweep {timestamp} in {self.file}") @ self.ego_T_lidar
        nanoseconds = timestamp if timestamp >= _FIRST_NANOSECOND else timestamp * 1000
        return Sweep(points[:, :3], is_ground, pose, nanoseconds)

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1); None where the sweep has no `flow`.

        Raises:
            CFlowError: no such sweep, or its labels cannot be read.
        """
        timestamp = self._timestamp(index)
        stored = self._array(timestamp, "flow")
        if stored is None:
            return None
        rows = self._lidar(timestamp).shape[0]
        if stored.shape != (rows, 3):
            raise CFlowError(f"{self.file}: flow of sweep {timestamp} has shape {stored.shape}, expected ({rows}, 3)")
        flow = self._values(timestamp, "flow", stored, np.float32)
        category = self._column(timestamp, "flow_category_indices", rows)
        is_valid = self._column(timestamp, "flow_is_valid", rows, np.bool_)
        if category is None or is_valid is None:
            raise CFlowError(f"{self.file}: sweep {timestamp} has flow without flow_category_indices or flow_is_valid")
        if category.dtype.kind not in "iu" or category.max(initial=0) > _LARGEST_CATEGORY:
            raise CFlowError(
                f"{self.file}: flow_category_indices of sweep {timestamp} are {category.dtype} up to "
                f"{category.max(initial=0)}, expected integers up to {_LARGEST_CATEGORY}"
            )
        # Waymo has int8 and -1 = no label.
        return FlowLabels(flow, category.clip(0).astype(np.uint8), is_valid & (category >= 0))

    def eval_mask(self, index: int) -> Optional[np.ndarray]:
        """(N,) bool points to score, None where the sweep has no `eval_mask`."""
        timestamp = self._timestamp(index)
        return self._column(timestamp, "eval_mask", self._lidar(timestamp).shape[0], np.bool_)

    def stored_motion(self, index: int) -> StoredMotion:
        """Ego motion of the pair (index, index + 1) as the harness has it, by the poses as they are in the file.

        Raises:
            CFlowError: no such pair, or a pose that cannot be read or is no rigid motion.
        """
        poses = [self._pose(self._timestamp(k)) for k in (index, index + 1)]
        for pose in poses:
            rigid_transform(pose, f"pose of sweep {index} or {index + 1} of {self.file}")
        return StoredMotion(harness_motion(*poses), np.array_equal(self.ego_T_lidar, np.eye(4)))

    def keys(self, index: int) -> Tuple[str, ...]:
        """Names of everything that sweep `index` has, results included."""
        timestamp = self._timestamp(index)
        return tuple(sorted(names(self._group(timestamp).opened, f"{self.file}: sweep {timestamp}")))

    def values(self, index: int, key: str) -> np.ndarray:
        """What a sweep has under a key, as it is stored; (N, 1) columns become (N,).

        Args:
            index: number of the sweep.
            key: for example `lidar` (N, 3+), `ego_motion` (4, 4) to the next sweep as stored (of the ego frame),
                `flow_instance_id` (N,) 0 = background, `lidar_id` (N,), `lidar_dt` (N,) seconds, `lidar_center`
                (L, 4, 4) ego_T_sensor, `dufo`, `cluster`, or the name of a result, (N, 3) total flow.

        Raises:
            CFlowError: no such sweep or key; the message lists the keys.
        """
        timestamp = self._timestamp(index)
        stored = self._array(timestamp, key)
        if stored is None:
            raise CFlowError(f"{self.file}: sweep {timestamp} has no {key}; it has {', '.join(self.keys(index))}")
        values = self._values(timestamp, key, stored)
        return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values

    def eval_frames(self, index_file: Optional[Place] = None) -> List[int]:
        """Numbers of the sweeps to score, ascending.

        Args:
            index_file: OpenSceneFlow's index; None = `index_eval.pkl` beside the scene, if there is one.

        Returns:
            The scene's entries of the index file; without a file, the sweeps with `eval_mask`; without those, the
            sweeps with `flow`. The last sweep of the scene has no successor and is left out.

        Raises:
            CFlowError: the file is no index, or it names a sweep that the scene does not have.
        """
        beside = self.file.parent / "index_eval.pkl"
        if index_file is None and beside.is_file():
            index_file = beside
        if index_file is None:
            for key in ("eval_mask", "flow"):
                found = [k for k, stamp in enumerate(self.timestamps) if self._array(stamp, key) is not None]
                if found:
                    break
        else:
            number = {stamp: k for k, stamp in enumerate(self.timestamps)}
            stamps = [stamp for scene, stamp in read_index(index_file) if scene == self.log_id]
            missing = [stamp for stamp in stamps if stamp not in number]
            if missing:
                raise CFlowError(f"{index_file} names sweep {missing[0]}, which {self.file} does not have: delete it")
            found = sorted({number[stamp] for stamp in stamps})
        return [k for k in found if k < len(self.timestamps) - 1]

    @property
    def poses(self) -> np.ndarray:
        """(K, 4, 4) float64 `T_world_lidar` of every sweep, without reading any points."""
        stored = np.stack([self._pose(stamp).astype(np.float64) for stamp in self.timestamps])
        with np.errstate(all="ignore"):  # NaN stays NaN
            return stored @ self.ego_T_lidar

    def _stated_extrinsics(self) -> np.ndarray:
        """What the scene says about where its LiDAR sits."""
        what = f"{self.file}: attribute {EXTRINSIC}"
        with hdf5_errors(f"{what} cannot be read"):
            if EXTRINSIC in self._scene.attrs:
                attribute = self._scene.attrs.get_id(EXTRINSIC)
                check_numbers(attribute, what)
                if attribute.shape != (4, 4):
                    raise CFlowError(f"{what} has shape {attribute.shape}, expected (4, 4)")
                return np.asarray(self._scene.attrs[EXTRINSIC])
        first = self.timestamps[0]
        if not is_argoverse2(first) or self._array(first, "lidar") is None:
            return np.eye(4)
        points = self._values(first, "lidar", self._lidar(first))
        return recognized_extrinsics(first, points, self._column(first, "ground_mask", len(points), np.bool_))

    def _timestamp(self, index: int) -> int:
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"scene {self.log_id} has {len(self.timestamps)} sweeps, there is no sweep {index}")
        return self.timestamps[index]

    def _group(self, timestamp: int) -> Group:
        if self._last[0] != timestamp:  # a sweep is asked for one key after the other
            found = group(self._scene, str(timestamp), str(self.file))
            if found is None:
                raise CFlowError(f"{self.file} lists a sweep {timestamp} that it does not have; copy it again")
            self._last = timestamp, found
        return self._last[1]

    def _array(self, timestamp: int, key: str) -> Optional[Stored]:
        """What a sweep has under a key, not read yet; None where it is absent."""
        return array(self._group(timestamp), key, f"{self.file}: sweep {timestamp}")

    def _lidar(self, timestamp: int) -> Stored:
        """(N, 3+) points, not read yet."""
        stored = self._array(timestamp, "lidar")
        if stored is None or len(stored.shape) != 2 or stored.shape[1] < 3:
            shape = "none" if stored is None else f"shape {stored.shape}"
            raise CFlowError(f"{self.file}: lidar of sweep {timestamp} has {shape}, expected shape (N, 3+)")
        return stored

    def _pose(self, timestamp: int) -> np.ndarray:
        """(4, 4) pose as stored."""
        stored = self._array(timestamp, "pose")
        if stored is None or stored.shape != (4, 4):
            shape = "none" if stored is None else f"shape {stored.shape}"
            raise CFlowError(f"{self.file}: pose of sweep {timestamp} has {shape}, expected shape (4, 4)")
        return self._values(timestamp, "pose", stored)

    def _values(self, timestamp: int, key: str, stored: Stored, dtype: Any = None) -> np.ndarray:
        values = read(stored, f"{self.file}: {key} of sweep {timestamp}", dtype)
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite, which no step takes for a point
            return values if dtype is None else values.astype(dtype, copy=False)

    def _column(self, timestamp: int, key: str, rows: int, dtype: Any = None) -> Optional[np.ndarray]:
        """(N,) values of a key, also where it is stored as (N, 1); None where it is absent."""
        stored = self._array(timestamp, key)
        if stored is None:
            return None
        if stored.shape not in ((rows,), (rows, 1)):
            raise CFlowError(f"{self.file}: {key} of sweep {timestamp} has shape {stored.shape}, expected ({rows},)")
        return self._values(timestamp, key, stored, dtype).reshape(rows)


def _stamp(name: str, file: Path) -> int:
    if len(name) > len(str(_LAST)) or (name[0] == "0" and name != "0") or int(name) > _LAST:
        raise CFlowError(
            f"{file} has a sweep {name[:30]}, expected a time stamp up to {_LAST} that does not begin with 0"
        )
    return int(name)
