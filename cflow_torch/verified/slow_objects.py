"""Slow objects of pairs: find what may move by less than a pixel.

Between two sweeps, most pixels of a slow object stay where they are. But more of its slices are matched one pixel ahead
than one pixel behind: the object is *biased*. Registration starts with a motion of one pixel to that side, and keeps
the object static unless its result matches significantly better (`Registration.improves`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.indices import constant, flat_nonzero
from cflow_torch.verified.columns import count_slices
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.selection import Objects

# Least |a - b| of a biased object: in standard deviations of noise, and as a share of slices.
_BIAS_Z = 3
_LEAST_BIAS = 0.1
_AHEAD = ((0, 1), (1, -1), (1, 0), (1, 1))  # rows and columns of a pixel ahead, in four directions


def find_slow(sweeps: HeightSlicedSweeps, objects: Objects, flow: Tensor, longest: float | None) -> Tensor:
    """Return a motion of one pixel for biased objects of pairs, (G, 2) float64, x and y, metres per sweep interval.

    It is 0 for other objects, for those that move, and in windows with history.

    Args:
        flow: (G, 2) float64, x and y, metres per sweep interval; 0 = static.
        longest: metres; static objects that are longer at t+1 stay static. None = no bound.

    Convention: of the slices of both sweeps, a are matched only ahead and b only behind. An object is biased if, in one
        of four directions, (a - b)^2 >= z^2 (a + b), and |a - b| is at least a tenth of its slices. Of several
        directions, the one with the largest |a - b| counts. Ties: the first.

    Cost: eight lookups for each pixel of static objects of pairs.
    """
    if not sweeps.batch.has_pairs:
        return torch.zeros_like(flow)
    asked = ~(flow.any(1) | sweeps.has_history.index_select(0, objects.window))
    if longest is not None:
        asked &= objects.length_at_newest(sweeps) <= longest
    only_ahead, only_behind, total = _matched_slices(sweeps, objects, asked)
    bias = only_ahead - only_behind  # [4, G]
    is_significant = bias * bias >= _BIAS_Z**2 * (only_ahead + only_behind)
    is_biased = is_significant & (bias.abs() >= _LEAST_BIAS * total) & (total > 0)

    direction = bias.abs().masked_fill(~is_biased, 0).argmax(0)  # [G]
    sign = bias.gather(0, direction[None])[0].sign() * is_biased.any(0)
    ahead = constant(_AHEAD, torch.float64, bias.device).index_select(0, direction)  # [G, 2], rows and columns
    return ahead.flip(1) * (sweeps.grid.pixel_size * sign)[:, None]


def _matched_slices(sweeps: HeightSlicedSweeps, objects: Objects, wanted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Count the slices of objects that are matched only ahead, only behind, (4, G) int64 each, and all, (G,) int64.

    The counts of objects that are not wanted, (G,) bool, are 0. For t+1, "ahead" is the opposite side.
    """
    index = flat_nonzero(objects.by_object.spread(wanted) & (sweeps.pixels.step < 2))  # [K]
    of_object = objects.by_object[index]  # [K]
    pixels = sweeps.pixels[index]  # [K]
    sides = (*_AHEAD, *((-row, -col) for row, col in _AHEAD))
    sign = (2 * pixels.step.int() - 1)[:, None, None]  # -1 for t+1
    shift = constant(sides, torch.int32, index.device) * sign  # [K, 8, 2]
    matched = sweeps.columns.look_up(pixels, 1 - pixels.step, shift).t() & pixels.slices  # [8, K]
    ahead, behind = matched.view(2, len(_AHEAD), -1)
    return (
        of_object.sum(count_slices(ahead & ~behind)),
        of_object.sum(count_slices(behind & ~ahead)),
        of_object.sum(count_slices(pixels.slices)),
    )
