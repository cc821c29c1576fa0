"""Reader of raw Argoverse 2 sensor logs, with pyarrow alone."""

from __future__ import annotations

from pathlib import Path
from typing import Dict, List, Optional, Sequence, Union

import numpy as np
import pyarrow as pa

from cflow_torch.data.arrow_file import check_rows, shortened, texts
from cflow_torch.data.boxes import Boxes, flow_from_boxes
from cflow_torch.data.categories import CATEGORIES, CATEGORY_INDEX
from cflow_torch.data.feather_file import FeatherFile
from cflow_torch.data.folders import find_folders
from cflow_torch.data.ground import GroundRaster, get_rule, read_ground_raster
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.names import is_stamp
from cflow_torch.data.paths import Place, as_path, remote_errors
from cflow_torch.types import CFlowError, Sweep

QUATERNION_TOLERANCE = 1e-3  # a quaternion is a rotation only if its length is 1; stored values are within 1e-15
MIN_INTERIOR_POINTS = 1  # av2-api's data loader drops boxes that hold no point, so a track that empties ends
_INT64_MAX = (1 << 63) - 1
SEARCH_DEPTH = 4  # <root>/<data set>/sensor/<split>/<log>, the deepest layout in use

_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")
_FLOW = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


def find_av2_logs(root: Place) -> List[Path]:
    """Folders of all logs under a folder.

    Args:
        root: a log, a split (holds logs), or a folder of splits, at most four levels above the logs.

    Returns:
        Sorted folders that hold `sensors/lidar`; empty if there are none.

    Raises:
        CFlowError: `root` is no folder.
    """
    return find_folders(as_path(root), _is_log, SEARCH_DEPTH, "a log, or a folder of logs")


class AV2Log:
    """One Argoverse 2 sensor log; implements the `Log` protocol.

    Args:
        folder: log folder with `sensors/lidar/<ns>.feather` and `city_SE3_egovehicle.feather`.
        ground: rule for the map raster, "av2-api" or "bsfe" (`cflow_torch.data.ground`); None = no ground masks.
        require_ground: refuse a log whose map has no ground raster. Otherwise its sweeps have `is_ground` None.

    Attributes:
        log_id: name of the folder.
        timestamps: sweep times in nanoseconds, ascending.

    Convention: points are float32 in the ego frame of their sweep (stored as float16); poses are float64
    `T_world_ego`, world = city. Poses are read and checked when the log is opened, sweeps when asked for.

    Raises:
        CFlowError: no such folder, fewer than two sweeps, a file that cannot be read, columns that are missing or of
            the wrong type, poses that are no rigid motion or do not cover a sweep.
    """

    def __init__(self, folder: Place, ground: Optional[str] = "av2-api", require_ground: bool = False) -> None:
        self.folder = as_path(folder)
        if not _is_log(self.folder):
            raise CFlowError(f"{self.folder} is no Argoverse 2 log: it holds no folder sensors/lidar")
        self.log_id = self.folder.resolve().name
        self._files: Dict[int, Path] = {
            int(file.stem): file
            for file in (self.folder / "sensors" / "lidar").glob("*.feather")
            if is_stamp(file.stem)
        }
        self.timestamps: Sequence[int] = sorted(self._files)
        if len(self.timestamps) < 2:
            raise CFlowError(
                f"log {self.log_id} has {len(self.timestamps)} sweeps in sensors/lidar (<nanoseconds>.feather); "
                f"scene flow needs two or more"
            )
        self._poses = self._read_poses()
        self._rule = None if ground is None else get_rule(ground)
        self._raster: Optional[GroundRaster] = None
        if self._rule is not None:
            self._raster = read_ground_raster(self.folder / "map")
        if require_ground and self._raster is None:
            raise CFlowError(
                f"log {self.log_id} has no ground raster (map/*_ground_height_surface____*.npy) or ground=None was "
                f"given; fetch the map, or open the log with require_ground=False and segment the ground yourself"
            )

    def __len__(self) -> int:
        return len(self.timestamps)

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index`.

        Raises:
            CFlowError: no such sweep, or its file cannot be read.
        """
        timestamp = self._timestamp(index)
        points = self._points(timestamp)
        pose = self._poses[timestamp]
        is_ground = None
        if self._raster is not None and self._rule is not None:
            city = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
            is_ground = self._raster.is_ground(city, self._rule)
        return Sweep(points=points, is_ground=is_ground, pose=pose.copy(), timestamp_ns=timestamp)

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1).

        Taken from the first of these that the log has: `flow_labels/<ns of sweep t>.feather` (if that folder exists,
        a pair without a file has no truth); `flow_labels.feather` for the first pair; `annotations.feather` by the
        recipe of av2-api (boxes that hold no point count as absent), for pairs inside the annotated time.

        Returns:
            The labels; None where the log has none, as for its last sweep.

        Raises:
            CFlowError: no such sweep; a label file that cannot be read or has another number of rows than the sweep.
        """
        timestamp = self._timestamp(index)
        if index == len(self.timestamps) - 1:
            return None
        folder, first_pair = self.folder / "flow_labels", self.folder / "flow_labels.feather"
        annotations = self.folder / "annotations.feather"
        with remote_errors(self.folder):
            if folder.is_dir():
                file = folder / f"{timestamp}.feather"
                return self._stored_labels(file, timestamp) if file.exists() else None
            if index == 0 and first_pair.exists():
                return self._stored_labels(first_pair, timestamp)
            if annotations.exists():
                return self._labels_from_annotations(annotations, timestamp, self.timestamps[index + 1])
        return None

    def _timestamp(self, index: int) -> int:
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"log {self.log_id} has sweeps 0 ... {len(self.timestamps) - 1}, asked for {index}")
        return self.timestamps[index]

    def _points(self, timestamp: int) -> np.ndarray:
        """(N, 3) float32."""
        return _floats(_read(self._files[timestamp], ("x", "y", "z")), ("x", "y", "z"), np.float32)

    def _read_poses(self) -> Dict[int, np.ndarray]:
        """Sweep time -> (4, 4) float64 T_world_ego."""
        file = self.folder / "city_SE3_egovehicle.feather"
        table = _read(file, ("timestamp_ns", *_POSE))
        check_rows(file, table.num_rows)
        times = _integers(table, "timestamp_ns", file)
        row_of = {int(time): row for row, time in enumerate(times)}
        missing = [time for time in self.timestamps if time not in row_of]
        if missing:
            raise CFlowError(
                f"{file} has no pose for sweep {missing[0]}"
                + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
                + "; every sweep needs a pose at exactly its time stamp"
            )
        rows = [row_of[time] for time in self.timestamps]
        values = _floats(table, _POSE, np.float64)[rows]
        return dict(zip(self.timestamps, _transforms(values, file, self.timestamps)))

    def _stored_labels(self, file: Path, timestamp: int) -> FlowLabels:
        table = _read(file, (*_FLOW, "classes"), ("is_valid",))
        rows = len(self._points(timestamp))
        if table.num_rows != rows:
            raise CFlowError(
                f"{file} has {table.num_rows} rows but sweep {timestamp} has {rows} points; labels need one each"
            )
        category = _integers(table, "classes", file)
        if category.size and not 0 <= category.min() <= category.max() < len(CATEGORIES):
            raise CFlowError(
                f"{file}: classes are 0 ... {len(CATEGORIES) - 1}, got {category.min()} ... {category.max()}"
            )
        is_valid = np.ones(rows, dtype=bool)
        if "is_valid" in table.column_names:
            if not pa.types.is_boolean(table.schema.field("is_valid").type):
                raise CFlowError(f"{file}: is_valid must be bool, got {table.schema.field('is_valid').type}")
            is_valid = table.column("is_valid").to_numpy().astype(bool)
        return FlowLabels(flow=_floats(table, _FLOW, np.float32), category=category.astype(np.uint8), is_valid=is_valid)

    def _labels_from_annotations(self, file: Path, timestamp0: int, timestamp1: int) -> Optional[FlowLabels]:
        columns = ("timestamp_ns", "track_uuid", "category", *_SIZE, *_POSE)
        table = _read(file, columns, ("num_interior_pts",))
        check_rows(file, table.num_rows)
        times = _integers(table, "timestamp_ns", file)
        if not times.size or timestamp0 < times.min() or timestamp1 > times.max():
            return None
        used: np.ndarray = np.ones(len(times), dtype=bool)
        if "num_interior_pts" in table.column_names:
            used = _integers(table, "num_interior_pts", file) >= MIN_INTERIOR_POINTS
        boxes0, boxes1 = (
            _boxes(table.filter(pa.array(used & (times == time))), file) for time in (timestamp0, timestamp1)
        )
        T_ego1_ego0 = np.linalg.inv(self._poses[timestamp1]) @ self._poses[timestamp0]
        return flow_from_boxes(self._points(timestamp0), boxes0, boxes1, T_ego1_ego0)


def _is_log(folder: Path) -> bool:
    return (folder / "sensors" / "lidar").is_dir()


def _read(file: Path, required: Sequence[str], optional: Sequence[str] = ()) -> pa.Table:
    """The required columns of a feather file, without holes in them, and the optional ones that it has."""
    try:
        feather = FeatherFile(file)
    except FileNotFoundError:
        raise CFlowError(f"{file} is missing; copy it from the data set") from None
    except OSError as error:
        raise CFlowError(f"cannot read {file}: {error}; it may be truncated, copy it again") from error
    columns = (*required, *(name for name in optional if name in feather.names))
    table = feather.read(columns)
    holes = [name for name in columns if table.column(name).null_count]
    if holes:
        raise CFlowError(f"{file} has empty entries in {holes}")
    return table


def _floats(table: pa.Table, columns: Sequence[str], dtype: type) -> np.ndarray:
    """(rows, columns) array of floating-point columns."""
    wrong = {
        name: str(table.schema.field(name).type)
        for name in columns
        if not pa.types.is_floating(table.schema.field(name).type)
    }
    if wrong:
        raise CFlowError(f"columns {list(columns)} must be floating point, got {wrong}")
    values = np.empty((table.num_rows, len(columns)), dtype)
    for number, name in enumerate(columns):
        values[:, number] = table.column(name).to_numpy()
    return values


def _integers(table: pa.Table, column: str, file: Path) -> np.ndarray:
    """(rows,) int64."""
    kind = table.schema.field(column).type
    if not pa.types.is_integer(kind):
        raise CFlowError(f"{file}: {column} must be integer, got {kind}")
    values = table.column(column).to_numpy()
    if values.size and values.max() > _INT64_MAX:
        raise CFlowError(f"{file}: {column} holds {values.max()}, more than {_INT64_MAX}")
    return values.astype(np.int64)


def _transforms(values: np.ndarray, file: Path, names: Sequence[Union[int, str]]) -> np.ndarray:
    """(K, 4, 4) float64 from rows of qw qx qy qz tx ty tz."""
    norm = np.linalg.norm(values[:, :4], axis=1)
    for row in np.flatnonzero(~np.isfinite(values).all(axis=1) | ~(np.abs(norm - 1) <= QUATERNION_TOLERANCE)):
        raise CFlowError(
            f"{file}: the pose of {names[int(row)]} is no rigid motion: quaternion and translation must be finite, "
            f"the quaternion of length 1, got {values[row].tolist()}"
        )
    w, x, y, z = (values[:, :4] / norm[:, None]).T
    transforms = np.zeros((len(values), 4, 4))
    transforms[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1)
    transforms[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1)
    transforms[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    transforms[:, :3, 3] = values[:, 4:]
    transforms[:, 3, 3] = 1
    return transforms


def _boxes(table: pa.Table, file: Path) -> Boxes:
    """Boxes of one sweep, in the order of the file."""
    names = tuple(texts(table.column(name), file) for name in ("track_uuid", "category"))
    unknown = sorted(set(names[1]) - set(CATEGORIES[1:]))
    if unknown:
        raise CFlowError(f"{file}: unknown categories {shortened(unknown)}; the known ones are {CATEGORIES[1:]}")
    return Boxes(
        track_id=names[0],
        category=np.array([CATEGORY_INDEX[name] for name in names[1]], dtype=np.uint8),
        size=_floats(table, _SIZE, np.float64),
        pose=_transforms(_floats(table, _POSE, np.float64), file, names[0]),
    )
