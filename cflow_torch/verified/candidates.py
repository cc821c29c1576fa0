"""Candidates for the motion of every component: of each sweep, of all of them pooled, of others."""

from __future__ import annotations

from typing import List, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.dense.history import pool
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_amin


def make_candidates(estimates: Tensor, available: Tensor, intervals: Tensor, others: Sequence[Tensor] = ()) -> Tensor:
    """Motions that each component may have, in the order in which ties between them are decided.

    Args:
        estimates: (M, K, 2) float64, (y, x) finest pixels m -> t+1, nearest sweep first.
        available: (M, K) bool, False = there is no estimate; whatever stands there is not looked at.
        intervals: (M, K) float64, sweep intervals from m to t+1; at least 1 where an estimate is available.
        others: (M, 2) float64 each, pixels per sweep interval, motions from elsewhere: what the coarser level gave
            (`inherit`), what key points say.

    Returns:
        (M, C, 2) float64, finest pixels per sweep interval: the pool of the estimates (where K > 1), each estimate by
        its interval, the others. 0 stands for what is not known; it proves nothing, so it never wins.

    Convention:
        Of one estimate the pool is the estimate itself, so sweeps that a window lacks change no choice. No -0.0.

    Cost: linear in M K, two sorts along K.

    Source: pool: Sec. leverage_past_pcs.
    """
    is_known = available[:, :, None]
    per_interval = torch.where(is_known, estimates, torch.zeros_like(estimates)) / intervals.clamp(min=1)[:, :, None]
    found: List[Tensor] = [per_interval]
    if estimates.shape[1] > 1:
        found.insert(0, pool(F.pad(per_interval, (0, 1)), available)[:, None, :2])  # without any estimate: 0
    return torch.cat([*found, *(motion[:, None] for motion in others)], 1) + 0.0  # turns -0.0 into 0.0


def inherit(node: Tensor, num_nodes: int, above: Tensor, motion: Tensor) -> Tensor:
    """Motion of the coarser component that each component lies in.

    Args:
        node: (P,) int64, component of each occupied pixel (`Cells.pixel`), M = none.
        num_nodes: M.
        above: (P,) int64, coarser component of each occupied pixel, A = none.
        motion: (A, 2) float64, of each coarser component.

    Returns:
        (M, 2) float64.

    Convention:
        The coarser component of the first pixel (sweep t+1 before t, raster order) that has one; 0 if none has.
        Components are nested but for erosion, so that other pixels seldom have another one.

    Cost: two passes over the pixels.
    """
    pixel = flat_nonzero(above < len(motion))
    nobody = node.numel()
    first = segment_amin(pixel, node.index_select(0, pixel), num_nodes + 1, nobody)[:num_nodes]
    coarser = F.pad(above, (0, 1), value=len(motion)).index_select(0, first)
    return F.pad(motion, (0, 0, 0, 1)).index_select(0, coarser)
