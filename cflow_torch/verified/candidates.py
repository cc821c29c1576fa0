"""Motion candidates of components: peaks of the correlation with each sweep, their pool, motions from elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Sequence, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import VerifiedConfig
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.history import pool
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.parabola import vertex
from cflow_torch.verified.component_tree import Level
from cflow_torch.verified.height_slices import HeightSlicedSweeps, count_slices
from cflow_torch.verified.keypoint_candidates import KeyPointMotion
from cflow_torch.verified.paired_test import VerifiedLevel


@dataclass(frozen=True)
class Candidates:
    """What M components may have done.

    Args:
        motion: (M, C, 2) float64, (y, x), finest pixels per sweep interval, in the order in which ties are decided; 0
            stands for what is not known.
        score: (P,) float32 of each occupied finest pixel: NCC of the finest component so far that was looked for.
    """

    motion: Tensor
    score: Tensor


def propose(
    level: Level,
    sweeps: HeightSlicedSweeps,
    above: Optional[VerifiedLevel],
    key_points: Optional[KeyPointMotion],
    config: VerifiedConfig,
) -> Candidates:
    """Candidates of the components of a level.

    Args:
        level: M components.
        sweeps: finest images.
        above: the coarser level: its components propose their motion to the parts. None = this is the coarsest.
        key_points: what they say; None = they are not asked.
        config: `max_speed`, `correlation`, `max_memory`.
    """
    wanted, others = ~level.too_long, []
    if above is not None:
        parent = level.parents(above.level)
        others.append(F.pad(above.motion, (0, 0, 0, 1)).index_select(0, parent))
        if level.is_undilated:  # what has not fallen apart is known
            wanted &= ~level.equals_parent(above.level, parent)
    if key_points is not None:
        others.append(key_points.of_components(level))
    estimates, scores, available = _find_peaks(level, wanted, sweeps, config)
    intervals = sweeps.elapsed[level.clusters.window, 1:]
    newest = available.int().argmax(1, keepdim=True)
    score = F.pad(scores.gather(1, newest)[:, 0], (0, 1)).index_select(0, level.component)
    if above is not None:
        score = torch.where(F.pad(wanted, (0, 1)).index_select(0, level.component), score, above.score)
    return Candidates(list_motions(estimates, available, intervals, others), score)


def list_motions(estimates: Tensor, available: Tensor, intervals: Tensor, others: Sequence[Tensor] = ()) -> Tensor:
    """(M, C, 2) float64, pixels per sweep interval: the pool of the estimates (where K > 1), each estimate by its
    interval, the others.

    Args:
        estimates: (M, K, 2) float64, (y, x) finest pixels m -> t+1, nearest sweep first.
        available: (M, K) bool, False = there is no estimate; whatever stands there is not looked at.
        intervals: (M, K) float64, sweep intervals from m to t+1; not 0 where an estimate is available.
        others: (M, 2) float64 each, pixels per sweep interval, motions from elsewhere.

    Convention:
        Of one estimate the pool is the estimate itself, so sweeps that a window lacks change no choice. No -0.0.

    Source: pool: Sec. leverage_past_pcs.
    """
    is_known = available[:, :, None]
    divisor = torch.where(available, intervals, torch.ones_like(intervals))
    per_interval = torch.where(is_known, estimates, torch.zeros_like(estimates)) / divisor[:, :, None]
    found: List[Tensor] = [per_interval]
    if estimates.shape[1] > 1:
        found.insert(0, pool(F.pad(per_interval, (0, 1)), available)[:, None, :2])  # without any estimate: 0
    return torch.cat([*found, *(motion[:, None] for motion in others)], 1) + 0.0  # turns -0.0 into 0.0


def _find_peaks(
    level: Level, wanted: Tensor, sweeps: HeightSlicedSweeps, config: VerifiedConfig
) -> Tuple[Tensor, Tensor, Tensor]:
    """Displacement m -> t+1 of components for every earlier sweep m, to parts of a pixel.

    Args:
        level: M components.
        wanted: (M,) bool, components that are looked for; the others cost nothing.
        sweeps, config: as for `propose`.

    Returns:
        estimates: (M, S - 1, 2) float64, (y, x), finest pixels m -> t+1, nearest sweep first.
        scores: (M, S - 1) float32, NCC at the peak.
        available: (M, S - 1) bool, False = not wanted, or no pixel in that sweep; both above are 0 there.

    Convention: a peak at no shift stays there. The parabola counts slices, whatever component they are of at t+1.
    """
    clusters = level.clusters.take(wanted)
    pairs = make_pairs(clusters, sweeps.batch, sweeps.grid.pixel_size * level.block, config.max_speed)
    shift, score = best_shifts(pairs, config.correlation, config.max_memory)
    moves = shift.any(1)
    moved = flat_nonzero(moves)
    peak, place = shift.index_select(0, moved), shift.double()
    corner, window = (
        values.index_select(0, pairs.cluster.index_select(0, moved)) for values in (clusters.first, clusters.window)
    )
    place[moved] = peak + _parabola(level.images, pairs, moves, corner, window, peak)

    shape = (wanted.numel(), sweeps.num_steps - 1)
    estimates = torch.zeros((*shape, 2), dtype=torch.float64, device=shift.device)
    scores = torch.zeros(shape, dtype=torch.float32, device=shift.device)
    available = torch.zeros(shape, dtype=torch.bool, device=shift.device)
    component = flat_nonzero(wanted).index_select(0, pairs.cluster)
    estimates[component, pairs.source] = place * level.block
    scores[component, pairs.source] = score
    available[component, pairs.source] = True
    return estimates, scores, available


def _parabola(
    images: Tensor, pairs: TemplatePairs, moves: Tensor, corner: Tensor, window: Tensor, shift: Tensor
) -> Tensor:
    """(K, 2) float64, (y, x), pixels: tops of the parabolas through the slices that templates share with sweep t+1.

    Args:
        images: (B, S, height, width) uint8, slices of each pixel.
        pairs: J of them.
        moves: (J,) bool, the K pairs that are asked about.
        corner: (K, 2) int64, (row, col) of the corner of each template.
        window: (K,) int64.
        shift: (K, 2) int64, (dy, dx), of the peak.
    """
    _, num_steps, height, width = images.shape
    flat = images.reshape(-1)
    template = pairs.template.take(moves)
    of_pixel, source = template.image, pairs.source.index_select(0, flat_nonzero(moves))
    top, left = corner.index_select(0, of_pixel).unbind(1)
    row, col = template.row + top, template.col + left
    newest = window.index_select(0, of_pixel) * (num_steps * height)  # first row of t+1
    line = newest + (source.index_select(0, of_pixel) + 1) * height + row
    own = flat.index_select(0, line * width + col)

    beside = torch.tensor(((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)), device=shift.device)
    dy, dx = shift.index_select(0, of_pixel).unbind(1)
    y, x = ((at + way)[:, None] + step for at, way, step in ((row, dy, beside[:, 0]), (col, dx, beside[:, 1])))
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    there = flat.index_select(0, ((newest[:, None] + y) * width + x).mul_(inside).view(-1)).view_as(inside)
    counts = count_slices(own[:, None] & there).long().mul_(inside)
    of_beside = of_pixel[:, None] * len(beside) + torch.arange(len(beside), device=shift.device)
    sums = torch.zeros(len(shift) * len(beside), dtype=torch.int64, device=shift.device)
    sums.index_add_(0, of_beside.view(-1), counts.view(-1))
    middle, above, below, left, right = sums.view(-1, len(beside)).unbind(1)
    return torch.stack((vertex(above, middle, below), vertex(left, middle, right)), 1)
