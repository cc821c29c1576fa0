"""Hypotheses and proof: candidate motions of all components judged against no motion, over all sweeps, both ways."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.ops.exact import exact_sqrt
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.height_slices import Cells, count_slices

# Look-ups (pixel x sweep x candidate) done at once: their temporaries take about 64 bytes each.
_LOOKS_ON_CPU = 1 << 18
_LOOKS_ON_GPU = 1 << 24


def judge(cells: Cells, node: Tensor, candidates: Tensor, judged: Tensor, elapsed: Tensor) -> Tuple[Tensor, Tensor]:
    """Paired counts of candidate motions against no motion.

    A slice of a pixel is won by a motion if another sweep has it where the motion takes the pixel and not where the
    pixel is; it is lost the other way round. Slices found in both places, or in neither, say nothing.

    Args:
        cells: finest images of all sweeps.
        node: (P,) int64, component of each occupied pixel, M = none.
        candidates: (M, C, 2) float64, (y, x) finest pixels per sweep interval, axes of ego1; C at least 1.
        judged: (M,) bool, False = its counts are 0 and cost nothing.
        elapsed: (B, S) float64, sweep intervals to t+1 (`Batch.elapsed`).

    Returns:
        won, lost: (M, C) int64 slices, summed over all sweeps m before t+1: m looks at t+1, t+1 looks at m.

    Convention:
        A pixel is taken by floor(k f + 0.5) pixels, elementwise float64; k = elapsed intervals, negative from t+1 into
        the past. What it meets counts whatever component it is of. Sweeps that a window lacks are empty: no counts.
        Fewer than 2^31 slices of a component may be compared.

    Cost: P (S - 1) C look-ups at most, of the pixels of judged components only.
    """
    num_nodes, num_candidates, _ = candidates.shape
    is_judged = torch.cat((judged, judged.new_zeros(1)))
    member = flat_nonzero(is_judged.index_select(0, node))
    source, target = _looks(cells, member)
    sums = torch.zeros(num_nodes * num_candidates, dtype=torch.int64, device=node.device)
    column = torch.arange(num_candidates, device=node.device)
    at_once = _LOOKS_ON_CPU if node.device.type == "cpu" else _LOOKS_ON_GPU
    size = max(1, at_once // num_candidates)
    for pixel, step in zip(source.split(size), target.split(size)):
        window, row, col = (values.index_select(0, pixel) for values in (cells.window, cells.row, cells.col))
        k = elapsed[window, cells.step.index_select(0, pixel)] - elapsed[window, step]  # one of the two is 0
        own, component = cells.slices.index_select(0, pixel)[:, None], node.index_select(0, pixel)
        here = own & cells.look_up(cells.place(window, step, row, col))[:, None]
        move = (candidates.index_select(0, component) * k[:, None, None] + 0.5).floor_().long()
        y, x = row[:, None] + move[:, :, 0], col[:, None] + move[:, :, 1]
        there = own & cells.look_up(cells.place(window[:, None], step[:, None], y, x))
        # Both counts in one number, because sums cost more than look-ups.
        counts = (count_slices(there & ~here).long() << 32) + count_slices(here & ~there)
        sums.index_add_(0, (component[:, None] * num_candidates + column).view(-1), counts.view(-1))
    sums = sums.view(num_nodes, num_candidates)
    return sums >> 32, sums & 0xFFFFFFFF


def _looks(cells: Cells, member: Tensor) -> Tuple[Tensor, Tensor]:
    """(L,) int64 each: pixels that look at another sweep, and the sweep. Some (K,) int64 pixels are members."""
    step = cells.step.index_select(0, member)
    older = member.index_select(0, flat_nonzero(step > 0))
    newest = member.index_select(0, flat_nonzero(step == 0))
    every = torch.arange(1, cells.num_steps, device=member.device)
    source = torch.cat((older, newest.repeat(every.numel())))
    return source, torch.cat((torch.zeros_like(older), every.repeat_interleave(newest.numel())))


def worth(won: Tensor, lost: Tensor, z: float) -> Tensor:
    """By how much each motion is proved: (won - lost) - z sqrt(won + lost), in sixteenths of a slice.

    Args:
        won, lost: int64 of one shape, below 2^31.
        z: standard deviations that luck is granted; 0 = every surplus counts.

    Returns:
        int64, same shape, rounded down; 0 = not proved.
    """
    surplus, luck = (won - lost).double(), exact_sqrt((won + lost).double())
    return (16 * (surplus - z * luck)).floor_().long().clamp_(min=0)


def choose(worths: Tensor, candidates: Tensor) -> Tuple[Tensor, Tensor]:
    """The motion of each component that is worth most.

    Args:
        worths: (M, C) int64, below 2^36 (C below 2^20), as `worth` gives them.
        candidates: (M, C, 2) float64.

    Returns:
        motion: (M, 2) float64; 0 where no candidate is worth anything.
        worth: (M,) int64, of that motion.

    Convention: of equal candidates the first.
    """
    num_candidates = worths.shape[1]
    reverse = torch.arange(num_candidates - 1, -1, -1, device=worths.device)
    key = (worths * num_candidates + reverse).amax(1)  # no two candidates have the same
    best_worth = torch.div(key, num_candidates, rounding_mode="floor")
    best = num_candidates - 1 - (key - best_worth * num_candidates)
    motion = candidates.gather(1, best[:, None, None].expand(-1, 1, 2))[:, 0]
    return motion.masked_fill((best_worth == 0)[:, None], 0.0), best_worth
