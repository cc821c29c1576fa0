"""Experimental reader of the Waymo Open Dataset, version 2 (parquet), with pyarrow alone."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Sequence

import numpy as np

from cflow_torch.data.boxes import Boxes, BoxLog, category_indices, upright_poses
from cflow_torch.data.files import file_errors, find_folders
from cflow_torch.data.log import FlowLabels
from cflow_torch.data.paths import PathLike, as_path, remote_errors
from cflow_torch.data.waymo import parquet
from cflow_torch.data.waymo.parquet import BOX, CALIBRATION, LASER, TIME, TRACK, Component, matrix_of
from cflow_torch.data.waymo.range_image import LASERS, NO_LABEL_ZONE, TOP, LaserCalibration, range_image_points
from cflow_torch.types import CFlowError, Sweep

SEARCH_DEPTH = 2  # <root>/<data set>/<split>
BOX_CATEGORY = {0: "NONE", 1: "REGULAR_VEHICLE", 2: "PEDESTRIAN", 3: "SIGN", 4: "BICYCLIST"}
"""Waymo's box type -> Argoverse 2 name. Trucks, buses and motorcycles have type 1, too; 0 is unknown."""

_KIND, _SIZE = f"{BOX}type", tuple(f"{BOX}box.size.{axis}" for axis in "xyz")
_HEADING_CENTRE = (f"{BOX}box.heading", *(f"{BOX}box.center.{axis}" for axis in "xyz"))
_KEPT_FRAMES = 2  # the labels of a pair are read after both of its sweeps


def find_waymo_segments(root: PathLike) -> list[Path]:
    """Find the LiDAR files `<split>/lidar/<segment>.parquet` of all segments, sorted.

    The root is such a file, a folder `lidar`, a split (holds `lidar`), or a folder at most three levels above `lidar`.
    Files of version 1 are a `CFlowError`.
    """
    root = as_path(root)
    if root.is_file() and root.suffix != ".tfrecord":
        return [root]
    what = "<split>/lidar/<segment>.parquet, or a split"
    root = root.parent if root.name == "lidar" else root
    if root.suffix == ".tfrecord" or next(root.glob("*.tfrecord"), None):
        raise CFlowError(
            f"{root}: .tfrecord is version 1 of the Waymo Open Dataset, which we do not read; download the parquet "
            "files of version 2 (same drives): lidar, lidar_pose, lidar_calibration, vehicle_pose, lidar_box"
        )
    splits = find_folders(root, lambda folder: (folder / "lidar").is_dir(), SEARCH_DEPTH, what)
    return sorted(file for split in splits for file in (split / "lidar").glob("*.parquet"))


class WaymoLog(BoxLog):
    """One segment. Experimental: of the released files we could test only the poses, no range images.

    Args:
        file: `<split>/lidar/<segment>.parquet`; the other components lie next to that folder, under the same name.
        lasers: names in `waymo.range_image.LASERS`. Those that the segment does not have are left out.
        both_returns: also read the second return of each pixel, after all first returns of its laser.

    Convention:
        - `timestamps` are the starts of the TOP scans.
        - Points are in the vehicle frame of their frame (x forward, y left, z up, origin at the rear axle), computed in
          float64: laser by laser, and row by row of the range image.
        - `T_world_ego` is `world_from_vehicle`, about the middle of the TOP scan.
        - The data set has no ground masks: `is_ground` is None.
        - Truth comes from box tracks. Points in a no-label zone are invalid; boxes of unknown type are background.

    Cost: opening reads keys, calibration and vehicle poses. A sweep decodes the row groups that hold its rows; the
        released files are not sorted by time, so that can be the whole file (seconds).
    """

    def __init__(self, file: PathLike, lasers: Sequence[str] = tuple(LASERS), both_returns: bool = False) -> None:
        self.file = as_path(file)
        if self.file.parent.name != "lidar":
            raise CFlowError(f"{self.file} is not in a folder lidar; pass <split>/lidar/<segment>.parquet")
        self.log_id = self.file.stem
        self._returns = (1, 2) if both_returns else (1,)
        self._images, self._pixel_poses = Component(self.file, "lidar"), Component(self.file, "lidar_pose")
        times = sorted({time for time, _ in self._images.frame_lasers()})
        self.timestamps = [time * 1000 for time in times]
        self._check_count(self.file)
        present = {laser for _, laser in self._images.frame_lasers()}
        names = [name for name, laser in LASERS.items() if laser in present]
        self._lasers = [LASERS[name] for name in names if name in lasers]
        if not self._lasers or not set(lasers) <= set(LASERS):
            raise CFlowError(f"{self.file}: lasers={list(lasers)}: choose some of {', '.join(names)}")
        self._calibration = self._read_calibration()
        component = Component(self.file, "vehicle_pose")
        stored = component.rows_by(TIME, times, (parquet.VEHICLE_POSE,)).items()
        poses = [matrix_of(values, f"{component.file}: the pose of frame {time}") for time, (values,) in stored]
        self._poses = np.stack(poses)
        if TOP in self._lasers:
            self._pixel_poses.frame_lasers()
        self._frame = lru_cache(_KEPT_FRAMES)(self._read_frame)

    def sweep(self, index: int) -> Sweep:
        time = self._timestamp(index)
        return Sweep(self._points(index).copy(), None, self._poses[index].copy(), time)

    def _points(self, index: int) -> np.ndarray:
        return self._frame(index)[0]

    def _labels(self, index: int) -> FlowLabels | None:
        labels = super()._labels(index)
        return labels and replace(labels, is_valid=labels.is_valid & ~self._frame(index)[1])

    def _read_frame(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Read the (N, 3) float32 points in the vehicle frame, and (N,) bool whether each lies in a no-label zone."""
        time = self.timestamps[index] // 1000
        keys = [(time, laser) for laser in self._lasers]
        images = [self._images.images(keys, f"{parquet.LIDAR}{number}", 4) for number in self._returns]
        pixel_poses = self._pixel_poses.images([(time, TOP)], parquet.PIXEL_POSE, 6) if TOP in self._lasers else {}
        if any(poses is None for poses in pixel_poses.values()):
            raise CFlowError(f"{self._pixel_poses.file} has no pixel poses of frame {time}; copy it again")
        points, zone = [np.zeros((0, 3))], [np.zeros(0, dtype=bool)]
        for key in keys:
            for image in (of_return[key] for of_return in images):
                if image is None:  # a laser, or a second return, without any data
                    continue
                calibration, poses = self._calibration[key[1]], pixel_poses.get(key)
                with file_errors(f"{self.file}, frame {time}, laser {key[1]}"):
                    found, pixels = range_image_points(image, calibration, self._poses[index], poses)
                points.append(found)
                zone.append(image.reshape(-1, image.shape[2])[pixels, NO_LABEL_ZONE] == 1)
        return np.concatenate(points).astype(np.float32), np.concatenate(zone)

    def _read_calibration(self) -> dict[int, LaserCalibration]:
        component = Component(self.file, "lidar_calibration")
        inclinations = (f"beam_inclination.{name}" for name in ("values", "min", "max"))
        columns = [f"{CALIBRATION}{name}" for name in ("extrinsic.transform", *inclinations)]
        calibration = {}
        for laser, (transform, table, low, high) in component.rows_by(LASER, self._lasers, columns).items():
            mount = matrix_of(transform, f"{component.file}: laser {laser}: extrinsic")
            calibration[laser] = LaserCalibration(mount, table or None, low, high)
        return calibration

    @cached_property
    def _box_rows(self) -> dict[int, list[dict[str, Any]]]:
        """Read frame time -> rows of its boxes; empty if the segment has no labels (the testing split)."""
        component, by_frame = Component(self.file, "lidar_box"), defaultdict(list)
        with remote_errors(component.file):
            if not component.file.exists():
                return {}
        for row in component.rows((TIME, TRACK, _KIND, *_SIZE, *_HEADING_CENTRE)):
            by_frame[row[TIME]].append(row)
        return by_frame

    def _boxes(self, index: int) -> Boxes | None:
        if not self._box_rows:
            return None
        rows = [row for row in self._box_rows[self.timestamps[index] // 1000] if row[_KIND] != 0]
        with file_errors(Component(self.file, "lidar_box").file):
            return Boxes(
                [str(row[TRACK]) for row in rows],
                category_indices([row[_KIND] for row in rows], BOX_CATEGORY),
                [[row[name] for name in _SIZE] for row in rows],
                upright_poses([[row[name] for name in _HEADING_CENTRE] for row in rows]),
            )
