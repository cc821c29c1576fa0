"""Where the LiDAR sits, in scenes of OpenSceneFlow's layout that do not say it themselves."""

from __future__ import annotations

from typing import Optional

import numpy as np

# Argoverse 2 counts nanoseconds from a moment of its own: all sweeps of the data set lie in here, no other set's do.
_ARGOVERSE2_STAMPS = (315_900_000_000_000_000, 316_000_000_000_000_000)
# Its up_lidar sits 2 m above the road, its ego frame 0.35 m: ground lower than this is seen from the sensor.
_ARGOVERSE2_SENSOR_GROUND = -1.2
# Extrinsics of up_lidar in one log of the set (7fab2350), yaw -0.58 degrees. Each log has its own, the scenes none.
_ARGOVERSE2_EGO_T_UP_LIDAR = np.array(
    [[0.9999483, 0.0101698, 0, 1.35018], [-0.0101698, 0.9999483, 0, 0], [0, 0, 1, 1.64042], [0, 0, 0, 1]]
)


def is_argoverse2(timestamp: int) -> bool:
    """Whether a sweep's time stamp is one of Argoverse 2."""
    low, high = _ARGOVERSE2_STAMPS
    return low <= timestamp < high


def recognized_extrinsics(timestamp: int, points: np.ndarray, is_ground: Optional[np.ndarray]) -> np.ndarray:
    """Coordinates of a scene's points to the frame whose poses it stores, by what a sweep looks like.

    Args:
        timestamp: name of the sweep.
        points: (N, 3+) float, metres, as stored.
        is_ground: (N,) bool, True = ground; None = unknown.

    Returns:
        (4, 4) float64 ego_T_lidar.

    Convention:
        A sweep with a time stamp of Argoverse 2 whose ground lies lower than 1.2 m below the origin has points in the
        frame of up_lidar and the pose of the ego frame: the extrinsics of one log of that set. Those of the scene's own
        log are not in its file: take them from `calibration/egovehicle_SE3_sensor.feather`. All other sets: the
        identity (nuScenes and ZOD have poses of the sensor, Waymo and TruckScenes points in the ego frame).
    """
    if not is_argoverse2(timestamp) or is_ground is None or not is_ground.any():
        return np.eye(4)
    if np.median(points[is_ground, 2]) > _ARGOVERSE2_SENSOR_GROUND:
        return np.eye(4)
    return _ARGOVERSE2_EGO_T_UP_LIDAR.copy()
