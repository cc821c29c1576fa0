"""Experimental reader of raw MAN TruckScenes: tables as in nuScenes, six LiDARs with PCD sweeps, not compensated."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Mapping, Sequence

import numpy as np

from cflow_torch.data.arrays.cloud_file import pcd_fields
from cflow_torch.data.files import check_columns, file_errors
from cflow_torch.data.nuscenes.reader import NUSCENES_CATEGORIES, OWN_TRAILER, Footprint, NuScenesLog
from cflow_torch.data.nuscenes.tables import SceneSource, find_scenes
from cflow_torch.data.paths import PathLike

TRUCKSCENES_CATEGORIES: dict[str, str] = {
    **NUSCENES_CATEGORIES,
    "animal": "NONE",
    "static_object.traffic_sign": "SIGN",
    "vehicle.other": "NONE",
    "vehicle.train": "NONE",
    OWN_TRAILER: "NONE",
}
"""Category of a box -> name in Argoverse 2, as for nuScenes."""


def find_truckscenes_scenes(root: PathLike) -> list[SceneSource]:
    """Find all scenes under a folder, see `nuscenes.tables.find_scenes`."""
    return find_scenes(root, ("log", "map"), "TruckScenes")


class TruckScenesLog(NuScenesLog):
    """One TruckScenes scene. Experimental: tested on simulated scenes only.

    Args:
        source: the scene, from `find_truckscenes_scenes`.
        sweep_step: 1 = all sweeps (10 Hz); n = every key frame, and every n-th sweep after it.
        lidars: channels to merge; None = every LiDAR of the scene (six).
        own_vehicle: rectangle of the vehicle seen from above. We remove its points, and those in boxes of
            `vehicle.ego_trailer`, if there are annotations. None = keep both.
        deskew: move each point with the pose that the vehicle had when it was measured; False: with the pose of its
            LiDAR's sweep.

    Attributes:
        timestamps: times of the reference LiDAR's sweeps (LIDAR_LEFT, else the first), in microseconds.

    Convention: points are in the ego frame at the reference's time stamp. From every other LiDAR we take the sweep
        closest in time; none if it is more than 60 ms off. The world is UTM, with coordinates of some 1e6 m. Between
        the reference's sweeps, poses are interpolated. All else is as in `NuScenesLog`.
    """

    _categories: ClassVar[Mapping[str, str]] = TRUCKSCENES_CATEGORIES
    _reference: ClassVar[str] = "LIDAR_LEFT"
    # |x| < 7 m and |y| < 2 m, as in OpenSceneFlow.
    OWN_VEHICLE: ClassVar[Footprint] = Footprint(rear=-7.0, front=7.0, half_width=2.0)

    def __init__(
        self,
        source: SceneSource,
        sweep_step: int = 1,
        lidars: Sequence[str] | None = None,
        own_vehicle: Footprint | None = OWN_VEHICLE,
        deskew: bool = True,
    ) -> None:
        super().__init__(source, sweep_step, lidars, own_vehicle)
        self._deskew = deskew

    def _points_of(self, content: bytes, file: Path) -> tuple[np.ndarray, np.ndarray | None]:
        with file_errors(file, "copy it again"):
            fields = pcd_fields(content)
        needed = ("x", "y", "z", "timestamp") if self._deskew else ("x", "y", "z")
        check_columns(file, list(fields), needed, "is it a sweep of TruckScenes?")
        points = np.stack([fields[axis].astype(np.float32) for axis in "xyz"], axis=1)
        return points, fields["timestamp"].astype(np.int64) if self._deskew else None
