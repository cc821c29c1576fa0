"""Reader of raw Argoverse 2 sensor logs, with pyarrow alone."""

from __future__ import annotations

from fnmatch import fnmatch
from functools import cached_property
from pathlib import Path
from typing import Any, Callable, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.arrays.cloud_file import read_columns
from cflow_torch.data.arrow_file import FeatherFile
from cflow_torch.data.boxes import Boxes, BoxLog, category_indices
from cflow_torch.data.camera import Camera, at_image, intrinsic_matrix
from cflow_torch.data.categories import CATEGORIES
from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.folders import visible
from cflow_torch.data.json_file import read_json
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.npy_file import read_npy
from cflow_torch.data.paths import PathLike, as_path, exist, is_timestamp, remote_errors, safe_name
from cflow_torch.data.trajectory import Trajectory, fit_to_sweeps
from cflow_torch.transforms import poses_at, poses_from_quaternions, transform_points
from cflow_torch.types import CFlowError, Sweep, check_array, vector_columns

# Rule -> largest distance of a ground point from the surface, metres, and the function that rounds grid positions to
# cells (towards zero, or half to even).
GROUND_RULES: dict[str, tuple[float, Callable[[np.ndarray], Any]]] = {
    "av2-api": (0.3, np.trunc),
    "bsfe": (0.4, np.round),
}

_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_SIZE = ("length_m", "width_m", "height_m")


class GroundRaster(NamedTuple):
    """Ground height on a grid of the city.

    Source: layout of the Argoverse 2 map folder, `*_ground_height_surface____*.npy` and `*___img_Sim2_city.json`.
    """

    heights: np.ndarray  # (H, W) float64, metres, row from y, column from x; NaN = unknown
    rotation: np.ndarray  # (2, 2) float64
    translation: np.ndarray  # (2,) float64
    scale: float  # cells per metre. The grid position of a city point is scale * (rotation @ xy + translation).

    def is_ground(self, points: np.ndarray, rule: str = "av2-api") -> np.ndarray:
        """Return whether each point is ground, (N,) bool, by a rule of `GROUND_RULES`.

        `points` are (N, 3), metres, in the CITY frame. Points below the surface are ground, too. The result is False
        outside the raster and where its height is NaN.
        """
        threshold, to_cell = GROUND_RULES[rule]
        xyz: np.ndarray = np.asarray(points, dtype=np.float64)
        x_is_finite, y_is_finite = np.isfinite(xyz[:, :2]).T
        inside = x_is_finite & y_is_finite
        position = (np.where(inside[:, None], xyz[:, :2], 0.0) @ self.rotation.T + self.translation) * self.scale
        cell = to_cell(position).astype(np.int64)
        num_rows, num_columns = self.heights.shape
        column, row = cell.T
        inside &= (column >= 0) & (row >= 0) & (column < num_columns) & (row < num_rows)
        height = np.full(len(xyz), np.nan)
        height[inside] = self.heights[row[inside], column[inside]]
        with np.errstate(invalid="ignore"):
            above = xyz[:, 2] - height
            return (np.abs(above) <= threshold) | (above < 0)


def read_ground_raster(map_folder: Path) -> GroundRaster | None:
    """Read the ground raster in the folder `map` of a log; None = it has none. More than one is a `CFlowError`."""
    names = ("*_ground_height_surface____*.npy", "*___img_Sim2_city.json")
    rasters, alignments = ([path for path in sorted(visible(map_folder)) if fnmatch(path.name, name)] for name in names)
    if not rasters:
        return None
    if len(rasters) > 1 or len(alignments) != 1:
        found = f"found {len(rasters)} and {len(alignments)}"
        raise CFlowError(f"{map_folder} must hold one {names[0]} and one {names[1]}, {found}")
    heights = read_npy(rasters[0], "copy the map folder again")
    check_array(heights, str(rasters[0]), (None, None), "fiu", "a file of (H, W) numbers")
    with file_errors(alignments[0], "copy the map folder again"):
        alignment = read_json(alignments[0])
        rotation, translation, scale = (np.array(alignment[key], dtype=np.float64) for key in "Rts")
        if not all(np.isfinite(values).all() for values in (rotation, translation, scale)):
            raise CFlowError("its numbers must be finite; copy the map folder again")
        return GroundRaster(heights.astype(np.float64), rotation.reshape(2, 2), translation.reshape(2), float(scale))


class AV2Log(BoxLog):
    """One Argoverse 2 sensor log.

    Args:
        folder: log folder with `sensors/lidar/<ns>.feather` and `city_SE3_egovehicle.feather`. Without this file, there
            are no poses; sweeps that it does not cover are left out (`fit_to_sweeps`). We warn of both.
        ground: rule for the map's ground raster, "av2-api" or "bsfe" (`GROUND_RULES`); None = no ground
            masks. A log whose map has no raster, or that has no poses, has no ground masks either.

    Convention:
        - Points are in the ego frame of their sweep (stored as float16). The world is the frame of the city.
        - Truth comes from the first of these sources that the log has: `flow_labels/<ns of sweep t>.feather` (if that
          folder exists, a pair without a file has no truth); `flow_labels.feather`, for the first pair;
          `annotations.feather`, for pairs inside the annotated time, if there are poses. Boxes without points are
          dropped, as in av2-api.
    """

    is_compensated: bool = True

    def __init__(self, folder: PathLike, ground: str | None = "av2-api") -> None:
        self.folder = as_path(folder)
        sweeps = self.folder / "sensors" / "lidar"
        if not sweeps.is_dir():
            raise CFlowError(f"{self.folder} is not an Argoverse 2 log: it has no folder sensors/lidar")
        self.log_id = self.folder.resolve().name
        self._files = {int(file.stem): file for file in sweeps.glob("*.feather") if is_timestamp(file.stem)}
        self.timestamps = sorted(self._files)
        self._check_count(f"{self.folder}: sensors/lidar/<nanoseconds>.feather")
        self._driven = self._read_trajectory()
        self._poses = None
        if self._driven is not None:
            self._poses, is_known, note = fit_to_sweeps(self._driven, self.timestamps)
            self._note(note)
            self._keep(is_known, f"{self.folder}: without the sweeps that have no pose, it")
        if ground is not None and ground not in GROUND_RULES:
            raise CFlowError(f"ground rules are {sorted(GROUND_RULES)}, got {ground!r}")
        self._rule, self._raster = ground, read_ground_raster(self.folder / "map") if ground else None

    def _read_trajectory(self) -> Trajectory | None:
        """Read all poses of the vehicle; None, with a warning, if their file is missing."""
        file = self.folder / "city_SE3_egovehicle.feather"
        if not exist(file):
            self._note(f"{file} is missing, so it has no poses. Download it, or set data.odometry=true")
            return None
        stored = FeatherFile(file)
        times, rows = np.unique(stored.vector("timestamp_ns", np.int64), return_index=True)
        return Trajectory(_poses(stored, rows, times.tolist()), times, False, str(file))

    def sweep(self, index: int) -> Sweep:
        """Read sweep `index`, with a ground mask if the log has a raster and poses."""
        timestamp = self._timestamp(index)
        stored, pose, is_ground = FeatherFile(self._files[timestamp]), self._pose(index), None
        points = stored.matrix("xyz", np.float32)
        # Logs of other writers may lack the times.
        times = stored.vector("offset_ns", np.int64) * 1e-9 if "offset_ns" in stored.names else None
        if self._raster is not None and self._rule and pose is not None:
            is_ground = self._raster.is_ground(transform_points(points, pose), self._rule)
        return Sweep(points, is_ground, pose, timestamp, times)

    def _labels(self, index: int) -> FlowLabels | None:
        folder, first_pair = self.folder / "flow_labels", self.folder / "flow_labels.feather"
        if exist(folder):
            file = folder / f"{self.timestamps[index]}.feather"
            return self._stored_labels(file, index) if exist(file) else None
        if index == 0 and exist(first_pair):
            return self._stored_labels(first_pair, index)
        return super()._labels(index)

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read intensity, laser_number, offset_ns and any other numeric column of sweep `index`."""
        return read_columns(self._files[self._timestamp(index)])

    def cameras(self, index: int) -> list[Camera]:
        """Return all cameras of `calibration`; without images in `sensors/cameras`, at the time of the sweep."""
        time = self._timestamp(index)
        cameras = []
        for name, (size, matrix, mount) in self._calibration.items():
            image_time = min(self._image_times[name], key=lambda each: abs(each - time), default=time)
            T_camera_ego = np.linalg.inv(mount)
            if self._driven is not None and image_time != time:
                times_ns: Any = self._driven.times_ns
                image_pose = poses_at(np.array([image_time]), times_ns, self._driven.poses)[0]
                T_camera_ego = at_image(mount, image_pose, self._pose(index))
            cameras.append(Camera(name, str(image_time), size, matrix, T_camera_ego, (image_time - time) * 1e-9))
        return cameras

    @cached_property
    def _calibration(self) -> dict[str, tuple[tuple[int, int], np.ndarray, np.ndarray]]:
        """Camera -> width and height, intrinsic matrix, (4, 4) `T_ego_camera`; {} without files of calibration."""
        intrinsics, mounts = (
            self.folder / "calibration" / f"{name}.feather" for name in ("intrinsics", "egovehicle_SE3_sensor")
        )
        if not exist(intrinsics, mounts):
            return {}
        stored = FeatherFile(mounts)
        sensors: list[str] = stored.read(("sensor_name",)).column(0).to_pylist()
        poses = dict(zip(sensors, _poses(stored, np.arange(stored.num_rows), sensors)))
        stored = FeatherFile(intrinsics)
        names: list[str] = stored.read(("sensor_name",)).column(0).to_pylist()
        numbers = stored.matrix(("fx_px", "fy_px", "cx_px", "cy_px"))
        sizes = stored.matrix(("width_px", "height_px"), np.int64)
        return {
            name: ((int(width), int(height)), intrinsic_matrix(*row), poses[name])
            for name, row, (width, height) in zip(names, numbers, sizes)
            if name in poses
        }

    @cached_property
    def _image_times(self) -> dict[str, list[int]]:
        """Camera -> times of its images, nanoseconds."""
        folder = self.folder / "sensors" / "cameras"
        with remote_errors(self.folder):
            return {
                name: [
                    int(file.stem)
                    for file in (folder / safe_name(name, "camera")).glob("*.jpg")
                    if is_timestamp(file.stem)
                ]
                for name in self._calibration
            }

    def _pose(self, index: int) -> Any:
        """Return a copy of the pose of sweep `index`, (4, 4); None = unknown."""
        return None if self._poses is None else self._poses[index].copy()

    def _points(self, index: int) -> np.ndarray:
        return FeatherFile(self._files[self.timestamps[index]]).matrix("xyz", np.float32)

    def _stored_labels(self, file: Path, index: int) -> FlowLabels:
        stored = FeatherFile(file)
        flow, category = stored.matrix(vector_columns("flow"), np.float32), stored.vector("classes", np.int64)
        rows = len(self._points(index))
        if stored.num_rows != rows:
            raise CFlowError(f"{file} has {stored.num_rows} rows but sweep {self.timestamps[index]} has {rows} points")
        if category.size and not 0 <= category.min() <= category.max() < len(CATEGORIES):
            found = f"{category.min()} ... {category.max()}"
            raise CFlowError(f"{file}: classes are 0 ... {len(CATEGORIES) - 1}, got {found}")
        is_valid = stored.vector("is_valid", bool) if "is_valid" in stored.names else np.ones(rows, dtype=bool)
        return FlowLabels(flow, category.astype(np.uint8), is_valid)

    @cached_property
    def _annotations(self) -> FeatherFile | None:
        file = self.folder / "annotations.feather"
        return FeatherFile(file) if exist(file) else None

    def _boxes(self, index: int) -> Boxes | None:
        """Read the boxes of a sweep, in the order of the file; None outside the annotated time."""
        stored, time = self._annotations, self.timestamps[index]
        if stored is None:
            return None
        times = stored.vector("timestamp_ns", np.int64)
        if not times.size or not times.min() <= time <= times.max():
            return None
        is_used = times == time
        if "num_interior_pts" in stored.names:  # av2-api's data loader drops boxes without points, so their track ends
            is_used &= stored.vector("num_interior_pts", np.int64) > 0
        rows = np.flatnonzero(is_used)
        tracks, names = stored.read(("track_uuid", "category")).take(rows).to_pydict().values()
        with file_errors(stored.file):
            category = category_indices(names, {name: name for name in CATEGORIES[1:]})
            return Boxes(tracks, category, stored.matrix(_SIZE)[rows], _poses(stored, rows, tracks))


def _poses(stored: FeatherFile, rows: np.ndarray, names: Sequence[int | str]) -> np.ndarray:
    values = stored.matrix(_POSE)[rows]
    return poses_from_quaternions(values[:, 4:], values[:, :4], lambda row: f"{stored.file}: the pose of {names[row]}")
