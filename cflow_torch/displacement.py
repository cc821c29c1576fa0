"""Displacement of each cluster between two sweeps: the peak of the correlation, and what is made of it."""

from __future__ import annotations

from typing import Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.cluster import Clusters
from cflow_torch.config import Config
from cflow_torch.correlate import best_shifts
from cflow_torch.drawing import Images
from cflow_torch.lookup import Lookup
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
        config: `zero_test`, `correlation`, `max_memory`.

    Returns:
        shift: (J, 2) int64, (dy, dx), pixels; 0 where it does not move.
        score: (J,) float32, NCC at that shift.

    Cost: `best_shifts` of what may move; the options look template pixels up in the target, a few times each.
    """
    engine, memory = config.correlation, config.max_memory
    if is_still is None and config.zero_test is None:
        return best_shifts(template, target, target_of_job, size, radius, engine, memory)
    lookup = Lookup(template, target, target_of_job, size)
    if is_still is None:
        shift, score = best_shifts(template, target, target_of_job, size, radius, engine, memory)
    else:
        may_move = ~is_still
        job_may_move = may_move.index_select(0, target_of_job)
        jobs = flat_nonzero(job_may_move)
        shift = torch.zeros((target_of_job.numel(), 2), dtype=torch.int64, device=size.device)
        score = lookup.score_of_no_shift()
        shift[jobs], score[jobs] = best_shifts(
            template.take(job_may_move),
            target.take(may_move),
            (may_move.cumsum(0) - 1).index_select(0, target_of_job.index_select(0, jobs)),
            size.index_select(0, flat_nonzero(may_move)),
            None if radius is None else radius.index_select(0, jobs),
            engine,
            memory,
        )
    if config.zero_test is not None:
        is_kept = beats_zero(lookup, shift, config.zero_test)
        shift = shift * is_kept[:, None]
        score = torch.where(is_kept, score, lookup.score_of_no_shift())
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


def is_longer(clusters: Clusters, length: float, pixel_size: float) -> Tensor:
    """(M,) bool: clusters whose pixels at t+1 have a bounding box with a side of more than `length` metres.

    Convention: the side in pixels times `pixel_size`, in float64; exactly `length` is not longer.
    """
    pixels = clusters.pixels
    newest = flat_nonzero(pixels.step == 0)
    row, col, cluster = (values.index_select(0, newest) for values in (pixels.row, pixels.col, pixels.cluster))
    _, size = bounding_boxes(row, col, cluster, clusters.window.numel())
    return size.amax(1).double() * pixel_size > length
