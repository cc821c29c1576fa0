"""Displacement of each cluster between two sweeps: the peak of the correlation, and what is made of it."""

from __future__ import annotations

from typing import Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.lookup import Coincidences, Lookup
from cflow_torch.dense.packing import Images
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import bounding_boxes

# z of the test is used to two decimals, so that the test is one of integers.
_Z_UNIT = 100


def displacements(
    template: Images,
    target: Images,
    target_of_job: Tensor,
    size: Tensor,
    radius: Optional[Tensor],
    is_still: Optional[Tensor],
    config: Config,
) -> Tuple[Tensor, Tensor]:
    """Where each template has gone in its target.

    Args:
        template, target, target_of_job, size, radius: as for `best_shifts`; J templates, N targets.
        is_still: (N,) bool, targets whose templates do not move; None = any may.
        config: `zero_test`, `subpixel`, `height_slices`, `correlation`, `max_memory`.

    Returns:
        shift: (J, 2) int64, or float64 with `subpixel`, (dy, dx), pixels; 0 where it does not move.
        score: (J,) float32, NCC at that shift, at the whole pixel.

    Cost: `best_shifts` of what may move; the options look template pixels up in the target, a few times each.
    """
    shift, score = _peaks(template, target, target_of_job, size, radius, is_still, config)
    if config.zero_test is None and config.subpixel == "none":
        return shift, score
    moves = shift.any(1)  # the rest stays where it is
    jobs = flat_nonzero(moves)
    peak = shift.index_select(0, jobs)
    lookup = Lookup(template.take(moves), target, target_of_job.index_select(0, jobs), size)
    if config.zero_test is not None:
        is_kept = beats_zero(lookup, peak, config.zero_test)
        peak = peak * is_kept[:, None]
        score[jobs] = torch.where(is_kept, score.index_select(0, jobs), lookup.score_of_no_shift())
    if config.subpixel == "parabola":
        shift = shift.double()
        peak = peak + parabola(lookup, peak) * peak.any(1)[:, None]
    shift[jobs] = peak
    return shift, score


def _peaks(
    template: Images,
    target: Images,
    target_of_job: Tensor,
    size: Tensor,
    radius: Optional[Tensor],
    is_still: Optional[Tensor],
    config: Config,
) -> Tuple[Tensor, Tensor]:
    """`best_shifts` of the templates that may move; of the others no shift and its score. Args as above."""
    engine, memory, num_slices = config.correlation, config.max_memory, max(config.height_slices, 1)
    if is_still is None:
        return best_shifts(template, target, target_of_job, size, radius, engine, memory, num_slices)
    may_move = ~is_still
    is_searched = may_move.index_select(0, target_of_job)
    jobs = flat_nonzero(is_searched)
    shift = torch.zeros((target_of_job.numel(), 2), dtype=torch.int64, device=size.device)
    score = Lookup(template, target, target_of_job, size).score_of_no_shift()
    shift[jobs], score[jobs] = best_shifts(
        template.take(is_searched),
        target.take(may_move),
        (may_move.cumsum(0) - 1).index_select(0, target_of_job.index_select(0, jobs)),
        size.index_select(0, flat_nonzero(may_move)),
        None if radius is None else radius.index_select(0, jobs),
        engine,
        memory,
        num_slices,
    )
    return shift, score


def beats_zero(lookup: Lookup, shift: Tensor, z: float) -> Tensor:
    """McNemar's test of shifts against no shift, over the pixels of each template as pairs.

    Args:
        lookup: J templates and their targets.
        shift: (J, 2) int64, (dy, dx), pixels.
        z: used to two decimals.

    Returns:
        (J,) bool: b > c and (b - c)^2 >= z^2 (b + c), where b pixels coincide by the shift only, c without it only.
        Never so for no shift. All numbers are integers.

    Source: McNemar, Note on the sampling error of the difference between correlated proportions, 1947.
    """
    moved, still = lookup.at(shift), lookup.at(torch.zeros_like(shift))
    won, lost = lookup.count(moved & ~still), lookup.count(still & ~moved)
    lead, unit = won - lost, round(z * _Z_UNIT)
    return (lead > 0) & (lead * lead * _Z_UNIT**2 >= (won + lost) * unit**2)


def parabola(lookup: Coincidences, shift: Tensor) -> Tensor:
    """Top of the parabola through the counts at each shift and one pixel beside it, per axis.

    Args:
        lookup: J templates and their targets.
        shift: (J, 2) int64, (dy, dx), pixels.

    Returns:
        (J, 2) float64, (y, x), pixels to add, within half a pixel; 0 where the counts do not curve downwards. One
        quotient of integers: the same everywhere.
    """
    top = lookup.count(lookup.at(shift))
    offsets = []
    for axis in (0, 1):
        step = torch.zeros_like(shift)
        step[:, axis] = 1
        low, high = lookup.count(lookup.at(shift - step)), lookup.count(lookup.at(shift + step))
        curve = 2 * top - low - high
        offset = (high - low).double() / (2 * curve).clamp(min=1).double()
        offsets.append(torch.where(curve > 0, offset, torch.zeros_like(offset)).clamp(-0.5, 0.5))
    return torch.stack(offsets, 1)


def is_longer(clusters: Clusters, length: float, pixel_size: float) -> Tensor:
    """(M,) bool: clusters whose pixels at t+1 have a bounding box with a side of more than `length` metres.

    Convention: the side in pixels times `pixel_size`, in float64; exactly `length` is not longer.
    """
    pixels = clusters.pixels
    newest = flat_nonzero(pixels.step == 0)
    row, col, cluster = (values.index_select(0, newest) for values in (pixels.row, pixels.col, pixels.cluster))
    _, size = bounding_boxes(row, col, cluster, clusters.window.numel())
    return size.amax(1).double() * pixel_size > length
