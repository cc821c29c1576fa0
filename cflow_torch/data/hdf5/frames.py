"""Frames of OpenSceneFlow's scenes: the mounting of the LiDAR, and the ego motion of its scripts (the harness)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.windows.ego_motion import compensate

# Argoverse 2 counts nanoseconds from its own epoch: all its sweeps are in this range, and no others are.
_ARGOVERSE2_STAMPS = (315_900_000_000_000_000, 316_000_000_000_000_000)
# Its up_lidar is 2 m above the road, its ego frame 0.35 m. If the ground is lower than this, points are up_lidar's.
_ARGOVERSE2_SENSOR_GROUND = -1.2
# Extrinsics of up_lidar in one log of the set (7fab2350), yaw -0.58 degrees. They differ by log; scenes lack them.
_ARGOVERSE2_EGO_T_UP_LIDAR = np.array(
    [[0.9999483, 0.0101698, 0, 1.35018], [-0.0101698, 0.9999483, 0, 0], [0, 0, 1, 1.64042], [0, 0, 0, 1]]
)


class StoredMotion(NamedTuple):
    """The ego motion that the harness uses for a pair of sweeps."""

    T_ego1_ego0: np.ndarray  # (4, 4) float32, from `harness_motion`
    of_points: bool  # True: the poses are of the frame of the points; False: of the frame to which `ego_T_lidar` maps


def is_argoverse2(timestamp: int) -> bool:
    """Test whether the time stamp of a sweep is one of Argoverse 2."""
    low, high = _ARGOVERSE2_STAMPS
    return low <= timestamp < high


def recognized_extrinsics(timestamp: int, points: np.ndarray, is_ground: np.ndarray | None) -> np.ndarray:
    """Recognise ego_T_lidar, (4, 4) float64, which maps the points of a scene to the frame of its stored poses.

    The arguments describe one sweep: its time stamp, its points as stored, (N, 3+) float in metres, and its ground
    mask, (N,) bool, None = unknown. If ground of Argoverse 2 is more than 1.2 m below the origin, points are in the
    frame of up_lidar, and poses of the ego frame: we return the extrinsics of one log, because the scene lacks its own.
    All other sweeps have the identity (nuScenes and ZOD: poses of the sensor; Waymo, TruckScenes: points of the ego).
    """
    if not is_argoverse2(timestamp) or is_ground is None:
        return np.eye(4)
    height = points[is_ground, 2]
    height = height[np.isfinite(height)]
    if len(height) == 0 or np.median(height) > _ARGOVERSE2_SENSOR_GROUND:
        return np.eye(4)
    return _ARGOVERSE2_EGO_T_UP_LIDAR.copy()


def harness_motion(pose0: Any, pose1: Any) -> np.ndarray:
    """Compute T_ego1_ego0, (4, 4) float32, from two stored poses T_world_ego as the harness does.

    The harness inverts a rotation by its transpose, and sums the translation of the inverse in the precision of the
    poses. With float32 poses kilometres from the origin, its motion and its scores are off by up to half a millimetre.
    """
    start, end = (torch.as_tensor(pose).detach().cpu() for pose in (pose0, pose1))
    inverse = torch.eye(4, dtype=torch.float64)
    inverse[:3, :3] = end[:3, :3].t()
    inverse[:3, 3] = -(end[:3, :3].t() * end[:3, 3]).sum(dim=1)
    return (inverse @ start.double()).float().numpy()


def harness_pose_flow(points: Tensor, T_ego1_ego0: np.ndarray) -> Tensor:
    """Return the pose flow of the harness, (N, 3) float32 metres, of (N, 3) points and a `harness_motion`."""
    transform = torch.from_numpy(T_ego1_ego0).to(points.device)
    return points @ transform[:3, :3].t() + transform[:3, 3] - points


def residual_for_harness(
    residual: Tensor, points: Tensor, T_ego1_ego0: np.ndarray, T_lidar1_lidar0: np.ndarray
) -> Tensor:
    """Return the residual flow that gives the right total flow in the harness, even with poses of another frame.

    `residual` and `points` are (N, 3) float32, metres; the points are in the frame of the LiDAR at t. `T_ego1_ego0` is
    the result of `harness_motion`. `T_lidar1_lidar0`, (4, 4) float64, is the motion of the frame of the points.
    """
    positions = points.t().double()
    correction = compensate(positions, T_lidar1_lidar0) - compensate(positions, T_ego1_ego0.astype(np.float64))
    return (residual.double() + correction.t()).float()
