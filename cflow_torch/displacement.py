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
        config: `correlation`, `max_memory`.

    Returns:
        shift: (J, 2) int64, (dy, dx), pixels; 0 where it does not move.
        score: (J,) float32, NCC at that shift.

    Cost: `best_shifts` of what may move; of the rest one look-up a pixel.
    """
    if is_still is None:
        return best_shifts(template, target, target_of_job, size, radius, config.correlation, config.max_memory)
    job_is_still = is_still.index_select(0, target_of_job)
    jobs, targets = flat_nonzero(~job_is_still), flat_nonzero(~is_still)
    number = (~is_still).cumsum(0) - 1
    found, found_score = best_shifts(
        template.take(~job_is_still),
        target.take(~is_still),
        number.index_select(0, target_of_job.index_select(0, jobs)),
        size.index_select(0, targets),
        None if radius is None else radius.index_select(0, jobs),
        config.correlation,
        config.max_memory,
    )
    shift = torch.zeros((job_is_still.numel(), 2), dtype=torch.int64, device=size.device)
    shift[jobs] = found
    score = Lookup(template, target, target_of_job, size).score_of_no_shift()
    score[jobs] = found_score
    return shift, score


def is_longer(clusters: Clusters, length: float, pixel_size: float) -> Tensor:
    """(M,) bool: clusters whose pixels at t+1 have a bounding box with a side of more than `length` metres.

    Convention: the side in pixels times `pixel_size`, in float64; exactly `length` is not longer.
    """
    pixels = clusters.pixels
    newest = flat_nonzero(pixels.step == 0)
    row, col, cluster = (values.index_select(0, newest) for values in (pixels.row, pixels.col, pixels.cluster))
    _, size = bounding_boxes(row, col, cluster, clusters.window.numel())
    return size.amax(1).double() * pixel_size > length
