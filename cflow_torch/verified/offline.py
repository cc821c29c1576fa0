"""Sweeps after t+1, for recordings. They help if an object has just appeared, and at the start of a log.

Past and future are two windows of one batch. A point of t takes its motion from the future only if the future shows its
object in more than twice as many sweeps as the past. In our tests, a single past sweep hardly improved a motion. Where
all past sweeps showed the object, the future gave no better motion.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, lookup, split_index
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import REACH, HeightSlicedSweeps
from cflow_torch.verified.paired_test import best_candidate, count_wins, evidence_of
from cflow_torch.verified.rigid_motion import RotatingMotion
from cflow_torch.windows.collation import Batch

# The future must show an object in more than this many times as many sweeps as the past. With a ratio of 1, façades
# that come into view as the ego vehicle moves get more false motion (simulated drives).
_RATIO = 2


def choose_side(batch: Batch, motion: RotatingMotion) -> RotatingMotion:
    """Assign each point of t to its pixel in the past or in the future window (`_RATIO`), and return that motion."""
    window, step = split_index(batch.image.long(), batch.num_steps)
    number = 1 + motion.cluster_id.index_select(0, motion.cluster(slice(None)))  # 0 = no object
    most = int(number.amax()) + 1 if number.numel() else 1
    row = window * most + number
    shows = torch.zeros((batch.num_windows * most, batch.num_steps), dtype=torch.bool, device=row.device)
    shows.view(-1).index_fill_(0, row * batch.num_steps + step, True)
    # Number of sweeps besides t and t+1 that show the object of each point.
    shown = shows[:, 2:].sum(1).index_select(0, row).masked_fill_(number == 0, 0)
    pixel, begin, end = motion.cell_of_point, batch.rows[0].start, batch.rows[-1].stop
    past, future = slice(begin, end), slice(end, 2 * end - begin)  # the same points of t
    chosen = torch.where(shown[future] > _RATIO * shown[past], pixel[future], pixel[past])
    return replace(motion, cell_of_point=pixel.slice_scatter(chosen, 0, begin, end))


def best_nearby(sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, significance: float) -> Tensor:
    """Return the motion with the most evidence among those within two pixels of the motion of each object.

    Later sweeps may show another side of an object than t. The correlation aligns one side with the other, so its peak
    is off by a pixel or two. The paired test over all sweeps chooses among the neighbours of the peak.

    The motion is (G, 2) float64, (y, x), finest pixels per sweep interval. Objects in windows without sweeps after t+1
    keep their motion. `significance` is the z of the paired test.

    Convention: we try offsets of whole pixels. Ties: the nearest motion, then the first in raster order.

    Cost: 25 lookups for each pixel and sweep of the moving objects.
    """
    line = torch.arange(-REACH, REACH + 1, device=motion.device)
    offsets = torch.cartesian_prod(line, line)
    offsets = offsets.index_select(0, (offsets * offsets).sum(1).sort(stable=True).indices)
    has_after = (sweeps.elapsed < 0).any(1).index_select(0, sweeps.pixels.window.index_select(0, objects.first))
    asked, candidates = motion.any(1) & has_after, motion[:, None] + offsets
    pixel = flat_nonzero(lookup(asked, objects.of_pixel))
    wins = count_wins(sweeps, sweeps.pixels.take(pixel), objects.of_pixel.index_select(0, pixel), candidates)
    best, evidence = best_candidate(evidence_of(wins.won[0], wins.lost[0], significance), candidates)
    return torch.where((evidence > 0)[:, None], best, motion)
