"""Rigid motions in float64: poses from quaternions (by kornia), interpolation in time, transformation of points."""

from __future__ import annotations

from typing import Any, Callable, Sequence

import numpy as np
import torch

from cflow_torch.types import CFlowError

QUATERNION_TOLERANCE = 1e-3  # only quaternions of length 1 are rotations; lengths in data sets are within 1e-6 of 1


def poses_from_quaternions(translation: Any, quaternion: Any, what: Callable[[int], str]) -> np.ndarray:
    """Build poses, (K, 4, 4) float64, from translations, (K, 3), and quaternions, (K, 4). K may be 0.

    Quaternions are scalar first (w, x, y, z), and of length 1 within `QUATERNION_TOLERANCE`. A row that is not a pose
    is a `CFlowError`, which begins with `what(row)`.
    """
    shift = np.asarray(translation, dtype=np.float64).reshape(-1, 3)
    rotation = np.asarray(quaternion, dtype=np.float64).reshape(-1, 4)
    is_unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) <= QUATERNION_TOLERANCE
    for row in np.flatnonzero(~(np.isfinite(shift).all(axis=1) & is_unit)):
        raise CFlowError(
            f"{what(int(row))} is not a rigid motion: quaternion (w, x, y, z) and translation must be finite, the "
            f"quaternion of length 1, got {rotation[row].tolist()}, {shift[row].tolist()}; copy the file again"
        )
    return _poses(to_rotations(rotation), shift)


def poses_from_json(nodes: Sequence[Any], translation: str, rotation: str, what: str) -> np.ndarray:
    """Return the poses of K JSON objects, (K, 4, 4) float64.

    `translation` and `rotation` are the keys of {x, y, z}, metres, and of the unit quaternion {w, x, y, z}. A pose that
    is not rigid is a `CFlowError`, in which `what` names the objects.
    """
    shifts = [[node[translation][axis] for axis in "xyz"] for node in nodes]
    quaternions = [[node[rotation][axis] for axis in "wxyz"] for node in nodes]
    return poses_from_quaternions(shifts, quaternions, lambda row: f"{what} {row}")


def poses_at(times: np.ndarray, known_times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Interpolate (M, 4, 4) poses, M >= 2, of (M,) ascending `known_times` at (K,) int64 times of the same unit.

    Return (K, 4, 4) float64. Before the first and after the last pose, the motion continues at a constant rate.
    """
    left = np.clip(np.searchsorted(known_times, times, side="right") - 1, 0, len(known_times) - 2)
    fraction = (times - known_times[left]) / (known_times[left + 1] - known_times[left])
    return interpolate_poses(poses[left], poses[left + 1], fraction)


def interpolate_poses(poses0: np.ndarray, poses1: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Interpolate between pairs of (K, 4, 4) float64 poses: positions linearly, rotations along the shorter arc.

    `fraction` is (K,) float64, 0 = the first pose, 1 = the second. Other values extrapolate at the same rate.
    """
    # Not kornia's `Quaternion.slerp`: before kornia 0.8 it may take the longer arc, and gives NaN for equal rotations.
    from kornia.geometry.conversions import axis_angle_to_quaternion, quaternion_to_axis_angle

    first, last = poses0[:, :3, :3], poses1[:, :3, :3]
    axis_angle = quaternion_to_axis_angle(torch.from_numpy(to_quaternions(np.swapaxes(first, 1, 2) @ last)))
    rotated = axis_angle_to_quaternion(axis_angle * torch.from_numpy(np.asarray(fraction, np.float64))[:, None])
    rotation = np.asarray(first, np.float64) @ to_rotations(rotated.numpy())
    return _poses(rotation, poses0[:, :3, 3] + fraction[:, None] * (poses1[:, :3, 3] - poses0[:, :3, 3]))


def transform_points(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return (N, 3) float64 points transformed by the rigid motion `T`, (4, 4) float64."""
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def transform_each(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return (N, 3) float64 points, each transformed by its own rigid motion; `T` is (N, 4, 4) float64."""
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (M, 3, 3) to unit quaternions (M, 4) float64, scalar first and not negative."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    matrices = torch.from_numpy(np.array(rotations, np.float64))
    found = rotation_matrix_to_quaternion(matrices, eps=0.0).numpy()  # kornia 0.7 adds eps before it takes the root
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    return np.where(found[:, :1] < 0, -found, found)


def to_rotations(quaternions: np.ndarray) -> np.ndarray:
    """Convert quaternions (M, 4), scalar first, of any length but 0, to rotation matrices (M, 3, 3) float64."""
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    return quaternion_to_rotation_matrix(torch.from_numpy(np.array(quaternions, np.float64))).numpy()


def _poses(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotation, translation
    return poses
