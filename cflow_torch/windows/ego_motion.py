"""Ego motion compensation: bring sweeps into the frame of t+1 with their poses (Eq. def_scene_flow), in float64."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.types import Array


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
