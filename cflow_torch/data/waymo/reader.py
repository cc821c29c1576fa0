"""Experimental reader of the Waymo Open Dataset, version 2 (parquet), with pyarrow alone."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Sequence, Tuple

import numpy as np
import pyarrow.parquet as pq

from cflow_torch.data.boxes import Boxes, BoxLog, category_indices
from cflow_torch.data.file_errors import check_columns, file_errors
from cflow_torch.data.folders import search, visible
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.paths import PathLike, as_path, exist, source_for_mmap, source_for_random_access
from cflow_torch.data.waymo.range_image import LASERS, NO_LABEL_ZONE, TOP, LaserCalibration, range_image_points
from cflow_torch.transforms import rigid_transform, upright_poses
from cflow_torch.types import CFlowError, Sweep

TIME, LASER, TRACK = "key.frame_timestamp_micros", "key.laser_name", "key.laser_object_id"
"""Key columns."""

LIDAR, PIXEL_POSE = "[LiDARComponent].range_image_return", "[LiDARPoseComponent].range_image_return1"
CALIBRATION, BOX = "[LiDARCalibrationComponent].", "[LiDARBoxComponent]."
VEHICLE_POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
"""Prefixes of the columns that we read; `VEHICLE_POSE` is a complete name."""

SEARCH_DEPTH = 2  # <root>/<data set>/<split>
BOX_CATEGORY = {0: "NONE", 1: "REGULAR_VEHICLE", 2: "PEDESTRIAN", 3: "SIGN", 4: "BICYCLIST"}
"""Waymo's box type -> Argoverse 2 name. Trucks, buses and motorcycles have type 1, too; 0 is unknown."""

_BOX_COLUMNS = (
    *("type", "box.size.x", "box.size.y", "box.size.z"),
    *("box.heading", "box.center.x", "box.center.y", "box.center.z"),
)
_BATCH = 8  # rows of range images in memory at once during the search for one
_KEPT_FRAMES = 2  # the labels of a pair are read after both of its sweeps
Key = Tuple[int, int]  # frame time in microseconds, laser


def find_waymo_segments(root: PathLike) -> list[Path]:
    """Find the LiDAR files `<split>/lidar/<segment>.parquet` of all segments, sorted.

    The root is such a file, a folder `lidar`, a split (holds `lidar`), or a folder at most three levels above `lidar`.
    Files of version 1 are a `CFlowError`.
    """
    root = as_path(root)
    what = "<split>/lidar/<segment>.parquet, or a split"
    root = root.parent if root.name == "lidar" else root
    if root.suffix == ".tfrecord" or next(root.glob("*.tfrecord"), None):
        raise CFlowError(
            f"{root}: .tfrecord is version 1 of the Waymo Open Dataset, which we do not read; download the parquet "
            "files of version 2 (same drives): lidar, lidar_pose, lidar_calibration, vehicle_pose, lidar_box"
        )

    def segments_of(split: Path) -> list[Path]:
        files = [path for path in visible(split / "lidar") if path.suffix == ".parquet"]
        return [split] if split.is_file() else files

    return sorted(search(root, segments_of, SEARCH_DEPTH, what))


class WaymoLog(BoxLog):
    """One segment. Experimental: we could test poses on released files, but no range images.

    Args:
        file: `<split>/lidar/<segment>.parquet`; the other components lie next to that folder, under the same name.
        lasers: names in `waymo.range_image.LASERS`. Those that the segment does not have are left out.
        both_returns: also read second returns; their points follow all first returns of their laser.

    Convention:
        - `timestamps` are the starts of the TOP scans.
        - Points are in the vehicle frame of their sweep (x forward, y left, z up, origin at the rear axle), computed in
          float64. They are ordered by laser, and by row of the range image.
        - `T_world_ego` is `world_from_vehicle`, about the middle of the TOP scan.
        - The data set has no ground masks: `is_ground` is None.
        - Truth comes from box tracks. Points in a no-label zone are invalid. We ignore boxes of unknown type.

    Cost: opening reads keys, calibration and vehicle poses. A sweep decodes the row groups that hold its rows; the
        released files are not sorted by time, so that can be the whole file (seconds).
    """

    is_compensated: bool = True

    def __init__(self, file: PathLike, lasers: Sequence[str] = tuple(LASERS), both_returns: bool = False) -> None:
        self.file = as_path(file)
        if self.file.parent.name != "lidar":
            raise CFlowError(f"{self.file} is not in a folder lidar; pass <split>/lidar/<segment>.parquet")
        self.log_id = self.file.stem
        self._returns = (1, 2) if both_returns else (1,)
        self._images = Component(self.file, "lidar")
        self._pixel_poses = Component(self.file, "lidar_pose")
        times = sorted({time for time, _ in self._images.row_of})
        self.timestamps = [time * 1000 for time in times]
        self._check_count(self.file)
        self._lasers = self._choose(lasers)
        self._calibration = self._read_lasers()
        component = Component(self.file, "vehicle_pose")
        poses = component.rows_by(TIME, times, (VEHICLE_POSE,))
        where = f"{component.file}: the pose of frame"
        self._poses = np.stack([matrix_of(values, f"{where} {time}") for time, (values,) in poses.items()])
        self._frame = lru_cache(_KEPT_FRAMES)(self._read_frame)

    def _choose(self, lasers: Sequence[str]) -> list[int]:
        """Return the numbers of the lasers to read, of those that the segment has."""
        present = {laser for _, laser in self._images.row_of}
        names = [name for name, laser in LASERS.items() if laser in present]
        chosen = [LASERS[name] for name in names if name in lasers]
        if not chosen or not set(lasers) <= set(LASERS):
            raise CFlowError(f"{self.file}: lasers={list(lasers)}: choose some of {', '.join(names)}")
        if TOP in chosen and not self._pixel_poses.row_of:
            raise CFlowError(f"{self._pixel_poses.file} is empty; copy it again")
        return chosen

    def sweep(self, index: int) -> Sweep:
        time = self._timestamp(index)
        return Sweep(self._points(index).copy(), None, self._poses[index].copy(), time)

    def _points(self, index: int) -> np.ndarray:
        return self._frame(index)[0]

    def _labels(self, index: int) -> FlowLabels | None:
        labels = super()._labels(index)
        return labels and replace(labels, is_valid=labels.is_valid & ~self._frame(index)[1])

    def _read_frame(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Read (N, 3) float32 points in the vehicle frame, and whether each lies in a no-label zone, (N,) bool."""
        time = self.timestamps[index] // 1000
        keys = [(time, laser) for laser in self._lasers]
        images = [self._images.images(keys, f"{LIDAR}{number}", 4) for number in self._returns]
        pixel_poses = None
        if TOP in self._lasers:
            pixel_poses = self._pixel_poses.images([(time, TOP)], PIXEL_POSE, 6)[time, TOP]
            if pixel_poses is None:
                raise CFlowError(f"{self._pixel_poses.file} has no pixel poses of frame {time}; copy it again")
        points = [np.zeros((0, 3))]
        is_zone = [np.zeros(0, dtype=bool)]
        for key in keys:
            for image in (of_return[key] for of_return in images):
                if image is None:  # a laser, or a second return, without any data
                    continue
                poses = pixel_poses if key[1] == TOP else None
                with file_errors(f"{self.file}, frame {time}, laser {key[1]}"):
                    of_image, pixels = range_image_points(image, self._calibration[key[1]], self._poses[index], poses)
                points.append(of_image)
                is_zone.append(image.reshape(-1, image.shape[2])[pixels, NO_LABEL_ZONE] == 1)
        return np.concatenate(points).astype(np.float32), np.concatenate(is_zone)

    def _read_lasers(self) -> dict[int, LaserCalibration]:
        component = Component(self.file, "lidar_calibration")
        inclinations = (f"beam_inclination.{name}" for name in ("values", "min", "max"))
        columns = [f"{CALIBRATION}{name}" for name in ("extrinsic.transform", *inclinations)]
        calibration = {}
        for laser, (transform, table, low, high) in component.rows_by(LASER, self._lasers, columns).items():
            mount = matrix_of(transform, f"{component.file}: laser {laser}: extrinsic")
            calibration[laser] = LaserCalibration(mount, table or None, low, high)
        return calibration

    @cached_property
    def _box_rows(self) -> dict[int, list[list[Any]]]:
        """Read the rows of boxes by frame time; empty if the segment has no labels (the testing split)."""
        component, by_frame = Component(self.file, "lidar_box"), defaultdict(list)
        if not exist(component.file):
            return {}
        for time, *row in component.rows((TIME, TRACK, *(f"{BOX}{name}" for name in _BOX_COLUMNS))):
            by_frame[time].append(row)
        return by_frame

    def _boxes(self, index: int) -> Boxes | None:
        if not self._box_rows:
            return None
        rows = [row for row in self._box_rows[self.timestamps[index] // 1000] if row[1] != 0]
        with file_errors(Component(self.file, "lidar_box").file):
            category = category_indices([row[1] for row in rows], BOX_CATEGORY)
            pose = upright_poses([row[5:] for row in rows])
            return Boxes([str(row[0]) for row in rows], category, [row[2:5] for row in rows], pose)


class Component:
    """The file `<split>/<tag>/<segment>.parquet` of a segment, opened when it is needed."""

    def __init__(self, segment: Path, tag: str) -> None:
        self.file = segment.parent.parent / tag / segment.name
        self._hint = f"download component {tag} of this segment"

    def rows(self, columns: Sequence[str]) -> list[tuple[Any, ...]]:
        """Read some columns, in the given order, of all rows."""
        with file_errors(self.file, self._hint):
            parquet = pq.ParquetFile(source_for_random_access(self.file))
            check_columns(self.file, parquet.schema_arrow.names, columns, self._hint)
            table = parquet.read(list(columns), use_threads=False)
            return list(zip(*(table.column(name).to_pylist() for name in columns)))

    def rows_by(self, key: str, wanted: Sequence[int], columns: Sequence[str]) -> dict[int, list[Any]]:
        """Read columns of the rows in which the key column has one of the wanted values: value -> columns."""
        rows = {value: row for value, *row in self.rows((key, *columns))}
        missing = [value for value in wanted if value not in rows]
        if missing:
            raise CFlowError(f"{self.file} has no row with {key} {missing[0]}; copy it again")
        return {value: rows[value] for value in wanted}

    @cached_property
    def row_of(self) -> dict[Key, int]:
        """Frame time and laser of every row -> its number."""
        return {(time, laser): row for row, (time, laser) in enumerate(self.rows((TIME, LASER)))}

    def images(self, keys: Sequence[Key], column: str, channels: int) -> dict[Key, np.ndarray | None]:
        """Read range images, (H, W, channels), by frame time and laser; None if the cell is null or empty.

        Give `column` without `.values` or `.shape`. Cost: decodes every row group that holds a wanted row, a few rows
        at a time.
        """
        missing = [key for key in keys if key not in self.row_of]
        if missing:
            raise CFlowError(f"{self.file} has no row for frame {missing[0][0]}, laser {missing[0][1]}; copy it again")
        rows = [self.row_of[key] for key in keys]
        columns = [TIME, LASER, f"{column}.values", f"{column}.shape"]
        images: dict[Key, np.ndarray | None] = {}
        with file_errors(self.file, self._hint):
            parquet = pq.ParquetFile(source_for_mmap(self.file))
            check_columns(self.file, parquet.schema_arrow.names, columns, self._hint)
            ends = np.cumsum([parquet.metadata.row_group(k).num_rows for k in range(parquet.num_row_groups)])
            groups = np.unique(np.searchsorted(ends, rows, side="right")).tolist()
            for batch in parquet.iter_batches(_BATCH, groups, columns, use_threads=False):
                for time, laser, values, shape in zip(*(batch.column(name) for name in columns)):
                    key = (time.as_py(), laser.as_py())
                    if key in keys:
                        images[key] = _image(values, shape, channels)
        return images


def matrix_of(values: Any, where: str) -> np.ndarray:
    """Return the (4, 4) float64 rigid motion of 16 numbers, row by row. Errors begin with `where`."""
    if values is None or len(values) != 16:
        raise CFlowError(f"{where} must have 16 numbers, row by row, got {0 if values is None else len(values)}")
    return rigid_transform(np.reshape(values, (4, 4)), where)


def _image(values: Any, shape: Any, channels: int) -> np.ndarray | None:
    """Return the (H, W, channels) image of a list cell; None if the cell is null or empty."""
    if not values.is_valid or not shape.is_valid or not len(values.values) or not len(shape.values):
        return None
    size, flat = shape.as_py(), values.values
    if len(size) != 3 or size[2] != channels or flat.null_count:
        raise ValueError(f"a range image must be (H, W, {channels}) without nulls, got {size}, {flat.null_count} nulls")
    return np.asarray(flat.to_numpy().reshape(size))
