"""Experimental reader of the Waymo Open Dataset, version 2 (parquet), with pyarrow alone."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Sequence

import numpy as np

from cflow_torch.data.boxes import Boxes, BoxLog, category_indices, make_boxes, upright_poses
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
        unknown = sorted(set(lasers) - set(LASERS))
        if unknown or not lasers:
            raise CFlowError(f"lasers={list(lasers)}: choose some of {', '.join(LASERS)}")
        if self.file.parent.name != "lidar":
            raise CFlowError(f"{self.file} is not in a folder lidar; pass <split>/lidar/<segment>.parquet")
        self.log_id = self.file.stem
        self._returns = (1, 2) if both_returns else (1,)
        self._images, self._pixel_poses = Component(self.file, "lidar"), Component(self.file, "lidar_pose")
        times = sorted({time for time, _ in self._images.frame_lasers()})
        self.timestamps = [time * 1000 for time in times]
        self._check_count(self.file)
        present = {laser for _, laser in self._images.frame_lasers()}
        self._lasers = [LASERS[name] for name in LASERS if name in lasers and LASERS[name] in present]
        if not self._lasers:
            raise CFlowError(f"{self.file} has lasers {sorted(present)}, none of {list(lasers)} ({LASERS})")
        self._calibration = self._read_calibration()
        self._poses = self._read_poses(times)
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

    def _boxes(self, index: int) -> Boxes | None:
        boxes = self._boxes_of_frames
        return boxes.get(self.timestamps[index] // 1000, make_boxes([], [], [], [])) if boxes else None

    def _read_frame(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Read the (N, 3) float32 points in the vehicle frame, and (N,) bool whether each lies in a no-label zone."""
        time = self.timestamps[index] // 1000
        keys = [(time, laser) for laser in self._lasers]
        images = [self._images.images(keys, f"{parquet.LIDAR}{number}", 4) for number in self._returns]
        pixel_pose = None
        if TOP in self._lasers:
            pixel_pose = self._pixel_poses.images([(time, TOP)], parquet.PIXEL_POSE, 6)[time, TOP]
            if pixel_pose is None:
                raise CFlowError(f"{self._pixel_poses.file} has no pixel poses of frame {time}; copy it again")
        points, zone = [np.zeros((0, 3))], [np.zeros(0, dtype=bool)]
        for key in keys:
            for image in (of_return[key] for of_return in images):
                if image is None:  # a laser, or a second return, without any data
                    continue
                poses = pixel_pose if key[1] == TOP else None
                with file_errors(f"{self.file}, frame {time}, laser {key[1]}"):
                    found, pixels = range_image_points(image, self._calibration[key[1]], poses, self._poses[index])
                points.append(found)
                zone.append(image.reshape(-1, image.shape[2])[pixels, NO_LABEL_ZONE] == 1)
        return np.concatenate(points).astype(np.float32), np.concatenate(zone)

    def _read_calibration(self) -> dict[int, LaserCalibration]:
        component = Component(self.file, "lidar_calibration")
        names = [f"{CALIBRATION}beam_inclination.{name}" for name in ("values", "min", "max")]
        rows = {row[LASER]: row for row in component.rows((LASER, f"{CALIBRATION}extrinsic.transform", *names))}
        missing = [laser for laser in self._lasers if laser not in rows]
        if missing:
            raise CFlowError(f"{component.file} has lasers {sorted(rows)}; lasers {missing} are missing, copy it again")
        calibration = {}
        for laser in self._lasers:
            row, where = rows[laser], f"{component.file}: laser {laser}"
            with file_errors(where):
                mount = matrix_of(row[f"{CALIBRATION}extrinsic.transform"], f"{where}: extrinsic")
                values, low, high = (row[name] for name in names)
                table = np.array(values, dtype=np.float64) if values else None
                ends = (0.0, 0.0) if values else (float(low), float(high))
                calibration[laser] = LaserCalibration(mount, table, *ends)
        return calibration

    def _read_poses(self, times: Sequence[int]) -> np.ndarray:
        component = Component(self.file, "vehicle_pose")
        stored = {row[TIME]: row[parquet.VEHICLE_POSE] for row in component.rows((TIME, parquet.VEHICLE_POSE))}
        missing = [time for time in times if time not in stored]
        if missing:
            raise CFlowError(f"{component.file} has no pose for frame {missing[0]}; copy it again")
        return np.stack([matrix_of(stored[time], f"{component.file}: the pose of frame {time}") for time in times])

    @cached_property
    def _boxes_of_frames(self) -> dict[int, Boxes]:
        """Read frame time -> boxes; empty if the segment has no labels (the testing split)."""
        component = Component(self.file, "lidar_box")
        file = component.file
        with remote_errors(file):
            if not file.exists():
                return {}
        size = [f"{BOX}box.size.{axis}" for axis in "xyz"]
        heading_centre = [f"{BOX}box.heading", *(f"{BOX}box.center.{axis}" for axis in "xyz")]
        kind, by_frame = f"{BOX}type", defaultdict(list)
        for row in component.rows((TIME, TRACK, kind, *size, *heading_centre)):
            by_frame[row[TIME]].append(row)
        boxes = {}
        for time, rows in by_frame.items():
            with file_errors(file):
                known = [row for row in rows if row[kind] != 0]
                boxes[time] = make_boxes(
                    [str(row[TRACK]) for row in known],
                    category_indices([row[kind] for row in known], BOX_CATEGORY),
                    [[row[name] for name in size] for row in known],
                    upright_poses([[row[name] for name in heading_centre] for row in known]),
                )
        return boxes
