"""Experimental reader of raw MAN TruckScenes: tables as in nuScenes, six LiDARs with PCD sweeps, not compensated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cflow_torch.data.arrays.pcd import pcd_fields
from cflow_torch.data.file_errors import check_columns, file_errors
from cflow_torch.data.nuscenes.reader import NUSCENES_CATEGORIES, OWN_TRAILER, Footprint, NuScenesLog
from cflow_torch.data.nuscenes.tables import SceneSource, find_scenes
from cflow_torch.data.paths import PathLike, read_bytes

TRUCKSCENES_CATEGORIES: dict[str, str] = {
    **NUSCENES_CATEGORIES,
    "animal": "NONE",
    "static_object.traffic_sign": "SIGN",
    "vehicle.other": "NONE",
    "vehicle.train": "NONE",
    OWN_TRAILER: "NONE",
}
"""Category of a box -> name in Argoverse 2; NONE = background, although its points move with the box."""


def find_truckscenes_scenes(root: PathLike) -> list[SceneSource]:
    """Find all scenes under a folder, see `nuscenes.tables.find_scenes`."""
    return find_scenes(root, ("log", "map"), "TruckScenes")


class TruckScenesLog(NuScenesLog):
    """One TruckScenes scene. Experimental: tested on simulated scenes only.

    Attributes:
        timestamps: sweep times of the reference LiDAR (LIDAR_LEFT, else the first), in nanoseconds, at 10 Hz.

    Convention: points are in the ego frame at the reference's time stamp. From every other LiDAR we take the sweep
        closest in time, unless it is more than 60 ms off. The world is UTM, with coordinates of some 1e6 m. We
        interpolate poses between the reference's sweeps. Unless `own_vehicle` is None, we also remove points in boxes
        of `vehicle.ego_trailer`. All else is as in `NuScenesLog`.
    """

    _categories = TRUCKSCENES_CATEGORIES
    _reference = "LIDAR_LEFT"
    _has_times = True
    OWN_VEHICLE = Footprint(rear=-7.0, front=7.0, half_width=2.0)  # as in OpenSceneFlow

    def _points_of(self, file: Path) -> tuple[np.ndarray, np.ndarray | None]:
        with file_errors(file, "copy it again"):
            fields = pcd_fields(read_bytes(file))
        needed = ("x", "y", "z", "timestamp") if self._deskew else ("x", "y", "z")
        check_columns(file, list(fields), needed, "is it a sweep of TruckScenes?")
        points = np.stack([fields[axis].astype(np.float32) for axis in "xyz"], axis=1)
        return points, fields["timestamp"].astype(np.int64) if self._deskew else None
