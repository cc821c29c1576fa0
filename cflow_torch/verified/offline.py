"""Sweeps after t+1, for whoever can wait: they show what comes out from behind something, or begins with the log.

With t and t+1 alone such an object is hard to follow; its future shows it as often as a past would. The motion is
estimated twice, by the sweeps before t and by those after t+1. A point of t goes by the future only where that shows
its object more than twice as often as the past does: a past of one sweep is hardly better than none, and with a full
one the future is no better (it was tried beside the past and in place of it), so there nothing changes.
"""

from __future__ import annotations

from typing import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import best_candidate, count_wins, evidence_of
from cflow_torch.verified.rigid_motion import TurningMotion, join
from cflow_torch.windows.collation import Batch

# How often the future must show an object for each time that the past does. At 1, façades that a moving ego vehicle
# uncovers get more false motion (simulated drives).
_TIMES = 2
# Pixels each way from the motion found: while an object comes into view, peaks are off by a pixel or two.
_REACH = 2


def motion_by_both_sides(batch: Batch, estimate: Callable[[Batch], TurningMotion]) -> TurningMotion:
    """The motion t -> t+1 of each point of t by the sweeps before t or by those after t+1.

    Args:
        batch: all sweeps.
        estimate: the method for the sweeps of one side; its clusters are those of the pixels of all its sweeps.

    Returns:
        A motion that has the points of t. In each window the ids of the second estimate go on after those of the first.

    Cost: that of two estimates.
    """
    is_after = (batch.elapsed < 0).any(0)
    if not bool(is_after.any()):
        return estimate(batch)
    is_pair = torch.arange(batch.num_steps, device=is_after.device) < 2
    before, after = batch.take_steps(~is_after), batch.take_steps(is_pair | is_after)
    first, second = estimate(before), estimate(after)
    takes_second = num_shown(after, second) > _TIMES * num_shown(before, first)
    return join(first, second, F.pad(takes_second, (batch.num_newest, 0)), batch)


def num_shown(batch: Batch, motion: TurningMotion) -> Tensor:
    """(N,) int64: how many sweeps beside t and t+1 show the object of each of the N points of t; 0 for no object."""
    window, step = split_index(batch.image.long(), batch.num_steps)
    number = 1 + motion.cluster_id.index_select(0, motion.cluster(slice(None)))
    most = int(number.amax()) + 1 if number.numel() else 1
    row = window * most + number
    shows = torch.zeros((batch.num_windows * most, batch.num_steps), dtype=torch.bool, device=row.device)
    shows.view(-1).index_fill_(0, row * batch.num_steps + step, True)
    at_t = flat_nonzero(step == 1)
    count = shows[:, 2:].sum(1).index_select(0, row.index_select(0, at_t))
    return count.masked_fill_(number.index_select(0, at_t) == 0, 0)


def best_nearby(sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, config: VerifiedConfig) -> Tensor:
    """The motion of most evidence among those within two pixels of the motion of each object.

    The part of an object that is seen at t lies anywhere on what later sweeps show of it, so peaks of the correlation
    slide. The paired test over all sweeps tells the right one, once it is asked.

    Args:
        sweeps: finest images; windows without sweeps after t+1 are left alone.
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        config: `significance`.

    Returns:
        (G, 2) float64, the same.

    Convention: whole pixels in y and in x; of equals the nearest, of those the first in raster order.

    Cost: 25 look-ups for each pixel and sweep of what moves.
    """
    line = torch.arange(-_REACH, _REACH + 1, device=motion.device)
    offsets = torch.cartesian_prod(line, line)
    offsets = offsets.index_select(0, (offsets * offsets).sum(1).sort(stable=True).indices)
    candidates = motion[:, None] + offsets
    has_after = (sweeps.elapsed < 0).any(1).index_select(0, sweeps.window.index_select(0, objects.first))
    wins = count_wins(sweeps, objects.of_pixel, candidates, motion.any(1) & has_after)
    best, evidence = best_candidate(evidence_of(*wins, config.significance), candidates)
    return torch.where((evidence > 0)[:, None], best, motion)
