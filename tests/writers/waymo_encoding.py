"""Encode returns as Waymo's range images, and for the laser on the roof as images of pixel poses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Callable

import numpy as np

from cflow_torch.data.waymo.range_image import (
    INTENSITY,
    RANGE,
    LaserCalibration,
    directions,
    rotations_from_angles,
)
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.types import CFlowError

_NODES = 4  # sweeps whose poses we interpolate by a cubic, which is exact for constant jerk
# Largest accepted error of interpolated poses, metres. Where a car begins to turn, the cubic is off by 0.3 m at 75 m
# in the street (0.4 rad/s), by 1.5 m at the crossing (0.8 rad/s), and by more at the ends of a drive.
_MAX_POSE_SHIFT = 1.0
_MAX_SHIFT = 0.005  # largest accepted distance of a return from its pixel's ray if pixels have no poses, metres


@dataclass(frozen=True)
class ShotPoses:
    """Poses of the vehicle at N shots.

    Args:
        of_shot: (N, 6) roll, pitch, yaw, x, y, z of `T_world_ego`; the angles are rounded to float32.
        of_frame: (6,) the same values for the pose of the frame.
        T_world_ego: (4, 4) float64, pose of the frame.
    """

    of_shot: np.ndarray
    of_frame: np.ndarray
    T_world_ego: np.ndarray

    def to_shot(self, points: np.ndarray, T_ego_sensor: np.ndarray) -> np.ndarray:
        """Transform points (N, 3) from the laser's frame at the pose of the frame to its frame at their shot."""
        world = self._world(points, T_ego_sensor)
        ego = np.einsum("nji,nj->ni", rotations_from_angles(self.of_shot[:, :3]), world - self.of_shot[:, 3:])
        return (ego - T_ego_sensor[:3, 3]) @ T_ego_sensor[:3, :3]

    def shifted_to(self, points: np.ndarray, on_rays: np.ndarray, T_ego_sensor: np.ndarray) -> np.ndarray:
        """(N, 6) poses of the shots, shifted so that they map `on_rays` (N, 3) to the true points (N, 3)."""
        ego = on_rays @ T_ego_sensor[:3, :3].T + T_ego_sensor[:3, 3]
        rotated = np.einsum("nij,nj->ni", rotations_from_angles(self.of_shot[:, :3]), ego)
        return np.concatenate([self.of_shot[:, :3], self._world(points, T_ego_sensor) - rotated], axis=1)

    def _world(self, points: np.ndarray, T_ego_sensor: np.ndarray) -> np.ndarray:
        T = self.T_world_ego @ T_ego_sensor
        return points @ T[:3, :3].T + T[:3, 3]


def poses_of_shots(log: Drive, index: int, offset_ns: np.ndarray) -> ShotPoses:
    """Interpolate poses at the times of shots by a cubic through angles and positions of the four nearest sweeps."""
    first = min(max(index - 1, 0), max(len(log.timestamps) - _NODES, 0))
    nodes = range(first, min(first + _NODES, len(log.timestamps)))
    values = np.stack([pose_angles(np.asarray(log.poses[node], np.float64)) for node in nodes])
    values[:, :3] = np.unwrap(values[:, :3], axis=0)
    seconds = np.array([(log.timestamps[node] - log.timestamps[index]) * 1e-9 for node in nodes])
    shots = np.asarray(offset_ns, np.float64) * 1e-9
    weights = np.ones((len(shots), len(nodes)))
    for k, own in enumerate(seconds):
        for other in np.delete(seconds, k):
            weights[:, k] *= (shots - other) / (own - other)
    of_shot = weights @ values
    of_shot[:, :3] = of_shot[:, :3].astype(np.float32)
    T_world_ego = np.asarray(log.poses[index], np.float64)
    return ShotPoses(of_shot, pose_angles(T_world_ego), T_world_ego)


def true_poses_of_shots(log: Any, index: int, offset_ns: np.ndarray) -> ShotPoses:
    """Return the true poses at the times of shots, from a recording that has `poses_at`, such as a `Drive`."""
    of_shot = pose_angles(log.poses_at(index, offset_ns))
    of_shot[:, :3] = of_shot[:, :3].astype(np.float32)
    return ShotPoses(of_shot, pose_angles(log.poses[index]), log.poses[index])


def encode_images(
    unit: UnitReturns,
    calibration: LaserCalibration,
    where: str,
    shot_poses: ShotPoses | None,
    true_poses: Callable[[], ShotPoses] | None = None,
) -> dict[str, np.ndarray]:
    """Return the images `first`, `second` (empty) and, if `shot_poses` are given, `poses`.

    If `shot_poses` are too inaccurate for a pixel, we encode the unit again with `true_poses`.
    """
    height = len(unit.elevations)
    width = unit.num_columns
    points = np.asarray(unit.points, np.float64)  # laser frame, at the pose of the frame
    seen = points if shot_poses is None else shot_poses.to_shot(points, calibration.T_ego_sensor)
    distance = np.linalg.norm(seen, axis=1).astype(np.float32)
    row = height - 1 - np.asarray(unit.ring, np.int64)
    # Column j has azimuth a_0 - 2 pi j / W.
    azimuths = calibration.column_azimuths(width)
    column = (azimuths[0] - np.arctan2(seen[:, 1], seen[:, 0])) / (2 * np.pi) * width
    column = np.rint(column).astype(np.int64) % width
    if shot_poses is not None and len(column):
        # Interpolated poses may be wrong by a pixel. So take the recording's columns, which differ by an offset only.
        start = np.bincount((column - unit.column) % width).argmax()
        column = (np.asarray(unit.column, np.int64) + start) % width
    rays = directions(azimuths[column], calibration.row_inclinations(height)[row])
    on_rays = distance[:, None].astype(np.float64) * rays
    shift = np.linalg.norm(seen - on_rays, axis=1)
    max_shift = _MAX_SHIFT if shot_poses is None else _MAX_POSE_SHIFT
    if len(shift) and shift.max() > max_shift:
        if true_poses is not None:
            return encode_images(unit, calibration, where, true_poses())
        raise CFlowError(
            f"{where}: {np.count_nonzero(shift > max_shift)} of {len(shift)} returns are off the rays of a {height} x "
            f"{width} range image, by up to {shift.max():.3g} m; record with a profile made for Waymo"
        )
    pixel = row * width + column
    if len(np.unique(pixel)) < len(pixel):
        raise CFlowError(f"{where}: {len(pixel) - len(np.unique(pixel))} returns share a pixel with another")
    image = np.full((height, width, 4), -1.0, np.float32)
    images: dict[str, np.ndarray] = {"second": image.copy()}
    image[row, column] = (0.0, 0.0, 0.0, -1.0)
    image[row, column, RANGE], image[row, column, INTENSITY] = distance, unit.intensity
    images["first"] = image
    if shot_poses is not None:
        images["poses"] = np.tile(shot_poses.of_frame, (height, width, 1)).astype(np.float32)
        images["poses"][row, column] = shot_poses.shifted_to(points, on_rays, calibration.T_ego_sensor)
    return images


def pose_angles(pose: np.ndarray) -> np.ndarray:
    """(..., 6) roll, pitch, yaw, x, y, z of transforms (..., 4, 4)."""
    roll = np.arctan2(pose[..., 2, 1], pose[..., 2, 2])
    yaw = np.arctan2(pose[..., 1, 0], pose[..., 0, 0])
    pitch = -np.arcsin(np.clip(pose[..., 2, 0], -1, 1))
    return np.concatenate([np.stack([roll, pitch, yaw], -1), pose[..., :3, 3]], -1)
