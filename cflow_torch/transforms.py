"""Rigid transforms, (4, 4) float64: check and make them, poses from quaternions, interpolate, transform points."""

from __future__ import annotations

from typing import Any, Callable, Sequence

import numpy as np
import torch

from cflow_torch.tensors import resolution
from cflow_torch.types import CFlowError, as_numpy, last_row

ROUNDING = 0.02  # of the length of a quaternion, and of |R R^T - I| of a matrix in a file, with two decimals
# A pose moves all points, so its type must resolve this distance, metres.
_COARSEST_POSE = 0.01
_FLATTEST = 1e-4  # metres from the middle of an arc to its chord; flatter ones are taken as straight
# Largest allowed |R R^T - I|. Poses stored in float32 are within 1e-6.
ORTHOGONALITY = 1e-3


def rigid_transform(matrix: Any, name: str, reach: float = 0.0) -> np.ndarray:
    """Check a rigid transform and convert it to (4, 4) float64. Any other matrix is a `CFlowError` with the `name`.

    The dtype must resolve a centimetre at the translation of the transform, and at `reach`, the distance of the
    farthest point in metres.
    """
    dtype = getattr(matrix, "dtype", None)
    try:
        result = as_numpy(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise CFlowError(f"{name} is {type(matrix).__name__}: give a (4, 4) matrix of numbers") from None
    if result.shape != (4, 4):
        wanted = f"give one (4, 4) matrix (no batch dimension){last_row(result.shape)}"
        raise CFlowError(f"{name} has shape {result.shape}: {wanted}")
    if not np.isfinite(result).all():
        raise CFlowError(f"{name} holds NaN or infinite values: give a finite rigid transform")
    rotation = result[:3, :3]
    bottom = result[3]
    with np.errstate(over="ignore", invalid="ignore"):  # values that are far from a rotation may overflow
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        determinant = np.linalg.det(rotation)
    wrong_row = np.abs(bottom - (0, 0, 0, 1)).max()
    if not (error <= ORTHOGONALITY and wrong_row <= ORTHOGONALITY and determinant > 0):
        raise CFlowError(
            f"{name} is not rigid (|R R^T - I| up to {error:.3g}, det {determinant:.3g}, last row "
            f"{bottom.tolist()}): give [R t; 0 0 0 1] with a right-handed rotation R, row-major"
        )
    farthest = max(reach, float(np.abs(result[:3, 3]).max()))
    step = max(resolution(kind, farthest) for kind in (np.dtype(np.float64), dtype) if kind is not None)
    if step > _COARSEST_POSE:
        raise CFlowError(
            f"{name} is {dtype or 'float64'}, which at {farthest:.9g} m only holds multiples of {step:g} m (at most "
            f"{_COARSEST_POSE} m): give it as float64, never rounded to less, or poses in a nearer frame"
        )
    return result


def relative_transform(pose1: Any, pose: Any) -> np.ndarray:
    """Return T_ego1_ego, (4, 4) float64, from two poses T_world_ego. Errors as in `rigid_transform`."""
    return np.linalg.inv(rigid_transform(pose1, "pose1")) @ rigid_transform(pose, "pose")


def as_matrix(rotation: np.ndarray, shift: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return the (..., 4, 4) float64 rigid transforms of (..., 3, 3) rotations and (..., 3) shifts, metres."""
    matrix = np.zeros((*rotation.shape[:-2], 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = shift
    matrix[..., 3, 3] = 1
    return matrix


def rotations_about(axis: int, angle: Any) -> np.ndarray:
    """Return the (..., 3, 3) float64 rotations by (...,) angles, radians, about x (0), y (1) or z (2)."""
    first = (axis + 1) % 3
    second = (axis + 2) % 3
    result = np.zeros((*np.shape(angle), 3, 3))
    result[..., axis, axis] = 1
    result[..., first, first] = result[..., second, second] = np.cos(angle)
    result[..., second, first] = np.sin(angle)
    result[..., first, second] = -np.sin(angle)
    return result


def rotations_of(angles: np.ndarray) -> np.ndarray:
    """Return the rotations, (K, 3, 3), of roll, pitch and yaw, (3, K) radians."""
    roll, pitch, yaw = (rotations_about(axis, angle) for axis, angle in enumerate(angles))
    return yaw @ pitch @ roll  # type: ignore[no-any-return]


def upright_poses(heading_centre: Any) -> np.ndarray:
    """Return (K, 4, 4) float64 poses of upright boxes, from rows of heading (radians about z) and x, y, z (metres)."""
    values = np.array(heading_centre, dtype=np.float64).reshape(-1, 4)
    return as_matrix(rotations_about(2, values[:, 0]), values[:, 1:])


def turn_of(T: np.ndarray) -> np.ndarray:
    """Return the angles of the rotations of rigid transforms, (..., 4, 4): (...) float64, radians."""
    trace = np.trace(T[..., :3, :3], axis1=-2, axis2=-1)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))  # type: ignore[no-any-return]


def poses_from_quaternions(translation: Any, quaternion: Any, what: Callable[[int], str]) -> np.ndarray:
    """Build poses, (K, 4, 4) float64, from translations, (K, 3), and quaternions, (K, 4). K may be 0.

    Quaternions are scalar first (w, x, y, z), and of length 1 within `ROUNDING`. A row that is not a pose
    is a `CFlowError`, which begins with `what(row)`.
    """
    shift = np.asarray(translation, dtype=np.float64).reshape(-1, 3)
    rotation = np.asarray(quaternion, dtype=np.float64).reshape(-1, 4)
    is_unit = np.abs(np.linalg.norm(rotation, axis=1) - 1) <= ROUNDING
    for row in np.flatnonzero(~(np.isfinite(shift).all(axis=1) & is_unit)):
        raise CFlowError(
            f"{what(int(row))} is not a rigid motion: quaternion (w, x, y, z) and translation must be finite, the "
            f"quaternion of length 1, got {rotation[row].tolist()}, {shift[row].tolist()}; are these the right columns?"
        )
    return as_matrix(to_rotations(rotation), shift)


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
    return as_matrix(rotation, poses0[:, :3, 3] + fraction[:, None] * (poses1[:, :3, 3] - poses0[:, :3, 3]))


def interpolate_motion(poses0: np.ndarray, poses1: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Interpolate between pairs of (K, 4, 4) float64 poses as a vehicle drives: on an arc, with constant body rates.

    `fraction` is (K,) float64, 0 = the first pose, 1 = the second. The result is (K, 4, 4) float64. Where the arc
    leaves the straight line by less than 0.1 mm, it is that of `interpolate_poses`.

    Source: the exponential map of rigid motions.
    """
    result = interpolate_poses(poses0, poses1, fraction)
    steps = np.linalg.inv(poses0) @ poses1
    angle = turn_of(steps)
    is_arc = np.linalg.norm(steps[:, :3, 3], axis=1) * angle / 8 > _FLATTEST
    steps, angle, share = steps[is_arc], angle[is_arc], fraction[is_arc]
    cross = (steps[:, :3, :3] - steps[:, :3, :3].transpose(0, 2, 1)) / (2 * np.sin(angle)[:, None, None])
    velocity = np.linalg.solve(_arc(cross, angle), steps[:, :3, 3:])
    shift = share[:, None] * (_arc(cross, share * angle) @ velocity)[..., 0]
    result[is_arc, :3, 3] = (poses0[is_arc, :3, :3] @ shift[..., None])[..., 0] + poses0[is_arc, :3, 3]
    return result


def _arc(cross: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Return the (K, 3, 3) matrices that map a constant velocity to the shift over turns by (K,) angles, radians."""
    half = np.where(angle == 0, 0, (1 - np.cos(angle)) / np.where(angle == 0, 1, angle))
    rest = np.where(angle == 0, 0, 1 - np.sin(angle) / np.where(angle == 0, 1, angle))
    return np.asarray(np.eye(3) + half[:, None, None] * cross + rest[:, None, None] * (cross @ cross))


def halfway(poses0: np.ndarray, poses1: np.ndarray) -> np.ndarray:
    """Return the (K, 4, 4) float64 poses midway between pairs: mean positions, half of the shorter rotation."""
    first = poses0[:, :3, :3]
    quaternions = to_quaternions(np.swapaxes(first, 1, 2) @ poses1[:, :3, :3])
    rotation = first @ to_rotations(quaternions + (1, 0, 0, 0))  # unit quaternions bisect their angle
    return as_matrix(rotation, (poses0[:, :3, 3] + poses1[:, :3, 3]) / 2)


def transform_points(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return (N, 3) float64 points transformed by the rigid motion `T`, (4, 4) float64."""
    return np.asarray(points, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]


def transform_each(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Return (N, 3) float64 points, each transformed by its own rigid motion; `T` is (N, 4, 4) float64."""
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def to_quaternions(rotations: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (M, 3, 3) to unit quaternions (M, 4) float64, scalar first and not negative."""
    r = np.asarray(rotations, np.float64).transpose(1, 2, 0)  # [3, 3, M]
    x, y, z = range(3)
    rows = (  # four times the products of all components
        (1 + r[x, x] + r[y, y] + r[z, z], r[z, y] - r[y, z], r[x, z] - r[z, x], r[y, x] - r[x, y]),
        (r[z, y] - r[y, z], 1 + r[x, x] - r[y, y] - r[z, z], r[x, y] + r[y, x], r[x, z] + r[z, x]),
        (r[x, z] - r[z, x], r[x, y] + r[y, x], 1 - r[x, x] + r[y, y] - r[z, z], r[y, z] + r[z, y]),
        (r[y, x] - r[x, y], r[x, z] + r[z, x], r[y, z] + r[z, y], 1 - r[x, x] - r[y, y] + r[z, z]),
    )
    products = np.array(rows).transpose(2, 0, 1)  # [M, 4, 4]
    largest = products.diagonal(axis1=1, axis2=2).argmax(1)  # its row has the smallest error
    row = products[np.arange(len(products)), largest]
    unit = row / np.linalg.norm(row, axis=1, keepdims=True)
    return np.where(unit[:, :1] < 0, -unit, unit)


def to_rotations(quaternions: np.ndarray) -> np.ndarray:
    """Convert quaternions (M, 4), scalar first, of any length but 0, to rotation matrices (M, 3, 3) float64."""
    # Not by kornia, whose import takes longer than opening a log.
    quaternions = np.asarray(quaternions, np.float64)
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    twice = 2 * unit[:, :, None] * unit[:, None, :]
    p = twice.transpose(1, 2, 0)  # [4, 4, M], twice the products of all components
    w, x, y, z = range(4)
    rows = (
        (1 - (p[y, y] + p[z, z]), p[x, y] - p[w, z], p[x, z] + p[w, y]),
        (p[x, y] + p[w, z], 1 - (p[x, x] + p[z, z]), p[y, z] - p[w, x]),
        (p[x, z] - p[w, y], p[y, z] + p[w, x], 1 - (p[x, x] + p[y, y])),
    )
    return np.array(rows).transpose(2, 0, 1).copy()
