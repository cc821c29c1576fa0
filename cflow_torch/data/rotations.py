"""Rotation matrices, unit quaternions (scalar first) and what lies between two rotations, by kornia."""

from __future__ import annotations

import numpy as np
import torch


def to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Unit quaternions (M, 4) float64, scalar first and not negative, of rotation matrices (M, 3, 3)."""
    from kornia.geometry.conversions import rotation_matrix_to_quaternion

    matrices = torch.from_numpy(np.array(rotations, np.float64))
    found = rotation_matrix_to_quaternion(matrices, eps=0.0).numpy()  # kornia 0.7 adds eps before it takes the root
    found = found / np.linalg.norm(found, axis=1, keepdims=True)
    return np.where(found[:, :1] < 0, -found, found)


def to_rotations(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (M, 3, 3) float64 of quaternions (M, 4), scalar first, of any length but 0."""
    from kornia.geometry.conversions import quaternion_to_rotation_matrix

    return quaternion_to_rotation_matrix(torch.from_numpy(np.array(quaternions, np.float64))).numpy()


def rotations_between(first: np.ndarray, last: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Rotations on the shorter way from one to another, at constant turn rate.

    Args:
        first, last: (M, 3, 3) rotation matrices.
        share: (M,) how far on the way, 0 = first, 1 = last.

    Returns:
        (M, 3, 3) float64.
    """
    # Not kornia's `Quaternion.slerp`: before kornia 0.8 it may take the longer way, and gives NaN for equal rotations.
    from kornia.geometry.conversions import axis_angle_to_quaternion, quaternion_to_axis_angle

    turn = quaternion_to_axis_angle(torch.from_numpy(to_quaternions(np.swapaxes(first, 1, 2) @ last)))
    part = axis_angle_to_quaternion(turn * torch.from_numpy(np.asarray(share, np.float64))[:, None])
    return np.asarray(first, np.float64) @ to_rotations(part.numpy())
