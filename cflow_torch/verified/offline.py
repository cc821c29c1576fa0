"""Sweeps after t+1, for recordings: they show objects that have just appeared, or that begin with the log.

Past and future are two windows of one batch. A point of t takes the motion that the future gives it only if the future
shows its object more than twice as often as the past does: a past of one sweep is hardly better than none, and with a
full one the future was not better in our tests.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, lookup, split_index
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import best_candidate, count_wins, evidence_of
from cflow_torch.verified.rigid_motion import RotatingMotion
from cflow_torch.windows.collation import Batch

# How often the future must show an object for each time that the past does. At 1, façades that a moving ego vehicle
# uncovers get more false motion (simulated drives).
_TIMES = 2
# Pixels each way from the motion found.
_REACH = 2


def choose_side(sides: Batch, copied: Tensor, motion: RotatingMotion) -> RotatingMotion:
    """The motion of each point by the past or by the future.

    Args:
        sides: the result of `Batch.split_past_and_future`: points, then copies of those of t+1 and t in windows of the
            future.
        copied: (K,) int64, the points that have copies.
        motion: of all of them.

    Returns:
        The same motion, in which points go by the pixels that decide.
    """
    num_points = sides.image.numel() - len(copied)
    shown = _num_shown(sides, motion)
    own, copy = shown.index_select(0, copied), shown[num_points:]
    pixel = torch.where(
        copy > _TIMES * own, motion.cell_of_point[num_points:], motion.cell_of_point.index_select(0, copied)
    )
    return replace(motion, cell_of_point=motion.cell_of_point.index_copy(0, copied, pixel))


def best_nearby(sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, significance: float) -> Tensor:
    """The motion of most evidence among those within two pixels of the motion of each object.

    The part of an object that is visible at t lies anywhere on what later sweeps show of it, so peaks of the
    correlation are off by a pixel or two. The paired test over all sweeps finds the right one, once it is asked.

    Args:
        sweeps: finest images; objects of windows without sweeps after t+1 keep their motion.
        objects: G of them.
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        significance: z of the paired test.

    Returns:
        (G, 2) float64.

    Convention: whole pixels in y and in x. Ties: the nearest, of those the first in raster order.

    Cost: 25 lookups for each pixel and sweep of the moving objects.
    """
    line = torch.arange(-_REACH, _REACH + 1, device=motion.device)
    offsets = torch.cartesian_prod(line, line)
    offsets = offsets.index_select(0, (offsets * offsets).sum(1).sort(stable=True).indices)
    has_after = (sweeps.elapsed < 0).any(1).index_select(0, sweeps.pixels.window.index_select(0, objects.first))
    asked, candidates = motion.any(1) & has_after, motion[:, None] + offsets
    pixel = flat_nonzero(lookup(asked, objects.of_pixel))
    wins = count_wins(sweeps, sweeps.pixels.take(pixel), objects.of_pixel.index_select(0, pixel), candidates)
    best, evidence = best_candidate(evidence_of(wins.won, wins.lost, significance), candidates)
    return torch.where((evidence > 0)[:, None], best, motion)


def _num_shown(batch: Batch, motion: RotatingMotion) -> Tensor:
    """(N,) int64: how many sweeps other than t and t+1 show the object of each of the N points; 0 for no object."""
    window, step = split_index(batch.image.long(), batch.num_steps)
    number = 1 + motion.cluster_id.index_select(0, motion.cluster(slice(None)))
    most = int(number.amax()) + 1 if number.numel() else 1
    row = window * most + number
    shows = torch.zeros((batch.num_windows * most, batch.num_steps), dtype=torch.bool, device=row.device)
    shows.view(-1).index_fill_(0, row * batch.num_steps + step, True)
    return shows[:, 2:].sum(1).index_select(0, row).masked_fill_(number == 0, 0)
