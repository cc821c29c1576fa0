"""Ego motion compensation: bring sweeps into the frame of t+1 with their poses (Eq. def_scene_flow), in float64."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from cflow_torch.types import Array, CFlowError, as_numpy, last_row
from cflow_torch.windows.validation import resolution

# A pose moves all points, so its type must resolve this distance, metres.
_COARSEST_POSE = 0.01
# Largest allowed |R R^T - I|. Poses stored in float32 are within 1e-6.
_ORTHOGONALITY = 1e-3


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
    if not (error <= _ORTHOGONALITY and wrong_row <= _ORTHOGONALITY and determinant > 0):
        raise CFlowError(
            f"{name} is not rigid (|R R^T - I| up to {error:.3g}, det {determinant:.3g}, last row "
            f"{bottom.tolist()}): give [R t; 0 0 0 1] with a rotation R, row-major"
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


def compensate(positions: Tensor, T_ego1_ego: Array | None, num_axes: int = 3) -> Tensor:
    """Transform positions to the frame of t+1 (Eq. def_scene_flow), and return their first A = `num_axes` axes, (A, N).

    Positions are (3, N) float64, metres. The transform is float64, (4, 4) or (3, 4, 1), or (3, 4, N), one per point;
    None = positions are in the frame of t+1 already. A point that is not finite has no finite coordinate afterwards.

    Convention: we compute ((R0 x + R1 y) + R2 z) + t with one rounding per operation, not as a matrix product. So every
    device returns the same bits.
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
