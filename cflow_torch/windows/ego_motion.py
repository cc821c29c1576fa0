"""Ego motion compensation: bring sweeps into the frame of t+1 with their poses (Eq. def_scene_flow), in float64."""

from __future__ import annotations

import math
from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.types import Array, CFlowError, as_numpy
from cflow_torch.windows.validation import resolution

# A pose moves all points, so its type must resolve this distance, metres.
_COARSEST_POSE = 0.01
# Largest allowed |R R^T - I|. Poses stored in float32 are within 1e-6.
_ORTHOGONALITY = 1e-3


def rigid_transform(matrix: Any, name: str, reach: float = 0.0) -> np.ndarray:
    """Check a rigid transform and convert it to (4, 4) float64; another matrix is a `CFlowError`.

    Args:
        matrix: (4, 4) array or tensor, whose type must resolve a centimetre.
        name: its name in errors, for example "T_ego1_ego0".
        reach: largest distance of a point from the origin, metres.
    """
    dtype = getattr(matrix, "dtype", None)
    try:
        result = as_numpy(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise CFlowError(f"{name} is {type(matrix).__name__}: give a (4, 4) matrix of numbers") from None
    if result.shape != (4, 4):
        raise CFlowError(f"{name} has shape {result.shape}: give one (4, 4) matrix (no batch dimension)")
    # Plain numbers: for sixteen of them NumPy takes ten times as long, once per sweep.
    rows = result.tolist()
    if not all(math.isfinite(value) for row in rows for value in row):
        raise CFlowError(f"{name} holds NaN or infinite values: give a finite rigid transform")
    x, y, z = (row[:3] for row in rows[:3])
    lengths = max(abs(_dot(axis, axis) - 1) for axis in (x, y, z))
    error = max(lengths, abs(_dot(x, y)), abs(_dot(x, z)), abs(_dot(y, z)))
    last_row = max(abs(value - expected) for value, expected in zip(rows[3], (0.0, 0.0, 0.0, 1.0)))
    determinant = _dot(x, (y[1] * z[2] - y[2] * z[1], y[2] * z[0] - y[0] * z[2], y[0] * z[1] - y[1] * z[0]))
    if error > _ORTHOGONALITY or last_row > _ORTHOGONALITY or determinant < 0:
        raise CFlowError(
            f"{name} is not rigid (|R R^T - I| up to {error:.3g}, det {determinant:.3g}, last row "
            f"{rows[3]}): give [R t; 0 0 0 1] with a rotation R, row-major"
        )
    farthest = max(reach, *(abs(row[3]) for row in rows[:3]))
    step = max(resolution(kind, farthest) for kind in (np.dtype(np.float64), dtype) if kind is not None)
    if step > _COARSEST_POSE:
        raise CFlowError(
            f"{name} is {dtype or 'float64'}, which at {farthest:.9g} m only holds multiples of {step:g} m (at most "
            f"{_COARSEST_POSE} m): give it as float64, never rounded to less, or poses in a nearer frame"
        )
    return result


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def relative_transform(pose1: Any, pose: Any) -> np.ndarray:
    """T_ego1_ego = inv(T_world_ego1) T_world_ego, (4, 4) float64, of two poses. Errors as in `rigid_transform`."""
    return np.linalg.inv(rigid_transform(pose1, "pose1")) @ rigid_transform(pose, "pose")


def compensate(positions: Tensor, T_ego1_ego: Array | None, num_axes: int = 3) -> Tensor:
    """Transform positions to the frame of t+1 (Eq. def_scene_flow).

    Args:
        positions: (3, N) float64, metres, in the ego frame of their sweep; rows x, y, z.
        T_ego1_ego: (4, 4) float64, array or tensor, or (3, 4, N), one per point; None = already in the frame of t+1.
        num_axes: A, number of coordinates; 2 = x and y only.

    Returns:
        (A, N) float64. A point that is not finite has no finite coordinate after a transform.

    Convention:
        ((R0 x + R1 y) + R2 z) + t with one rounding per operation instead of a matrix product: the same bits on every
        device.
    """
    if T_ego1_ego is None:
        return positions[:num_axes]
    x, y, z = positions.unbind(0)
    matrix = torch.as_tensor(T_ego1_ego[:num_axes], dtype=torch.float64, device=x.device)
    r0, r1, r2, t = matrix.view(*matrix.shape[:2], -1).unbind(1)
    result = r0 * x
    term = r1 * y
    result += term
    result += torch.mul(r2, z, out=term)
    result += t
    return result
