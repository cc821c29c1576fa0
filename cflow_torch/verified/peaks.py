"""Where the components of a level seem to have gone: peaks of the correlation with each sweep, to parts of a pixel."""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.displacement import parabola
from cflow_torch.dense.packing import Images
from cflow_torch.dense.templates import Jobs, make_jobs
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.height_slices import count_slices
from cflow_torch.verified.levels import Level
from cflow_torch.windows.collation import Batch


def find_peaks(
    level: Level, wanted: Tensor, batch: Batch, pixel_size: float, config: Config
) -> Tuple[Tensor, Tensor, Tensor]:
    """Displacement m -> t+1 of components for every earlier sweep m.

    Args:
        level: M components.
        wanted: (M,) bool, components that are looked for; the others cost nothing.
        batch: for the elapsed time of each sweep, S sweeps.
        pixel_size: metres, of the finest pixels.
        config: `max_speed`, `height_slices`, `correlation`, `max_memory`.

    Returns:
        estimates: (M, S - 1, 2) float64, (y, x), finest pixels m -> t+1, nearest sweep first.
        scores: (M, S - 1) float32, NCC at the peak.
        available: (M, S - 1) bool, False = not wanted, or no pixel in that sweep; both above are 0 there.

    Convention: a peak at no shift stays there. The parabola counts slices, whatever component they are of at t+1.
    """
    clusters = level.clusters.take(wanted)
    slices = None
    if config.height_slices > 0:
        pixels = clusters.pixels
        line = (clusters.window.index_select(0, pixels.cluster) * batch.num_steps + pixels.step) * level.height
        slices = level.image.index_select(0, (line + pixels.row) * level.width + pixels.col)
    jobs = make_jobs(clusters, batch, pixel_size * level.block, config.max_speed, slices)
    shift, score = best_shifts(
        jobs.template,
        jobs.target,
        jobs.cluster,
        clusters.size,
        jobs.radius,
        config.correlation,
        config.max_memory,
        max(config.height_slices, 1),
    )
    moves = shift.any(1)
    moved = flat_nonzero(moves)
    peak, place = shift.index_select(0, moved), shift.double()
    place[moved] = peak + parabola(_Meetings(level, clusters, jobs, moves, batch.num_steps), peak)

    shape = (wanted.numel(), batch.num_steps - 1)
    estimates = torch.zeros((*shape, 2), dtype=torch.float64, device=shift.device)
    scores = torch.zeros(shape, dtype=torch.float32, device=shift.device)
    available = torch.zeros(shape, dtype=torch.bool, device=shift.device)
    component = flat_nonzero(wanted).index_select(0, jobs.cluster)
    estimates[component, jobs.source] = place * level.block
    scores[component, jobs.source] = score
    available[component, jobs.source] = True
    return estimates, scores, available


class _Meetings:
    """Slices that templates share with sweep t+1 at given shifts; as `Lookup`, but in the images of a level.

    Args:
        level: its images.
        clusters, jobs: components and their jobs.
        wanted: (J,) bool, the K jobs that matter.
        num_steps: S.
    """

    def __init__(self, level: Level, clusters: Clusters, jobs: Jobs, wanted: Tensor, num_steps: int) -> None:
        template: Images = jobs.template.take(wanted)
        job = flat_nonzero(wanted)
        self._job, self._num_jobs, self._level = template.image, job.numel(), level
        component = jobs.cluster.index_select(0, job).index_select(0, template.image)
        source = jobs.source.index_select(0, job).index_select(0, template.image)
        top, left = clusters.first.index_select(0, component).unbind(1)
        self._row, self._col = template.row + top, template.col + left
        self._newest = clusters.window.index_select(0, component) * (num_steps * level.height)  # first row of t+1
        line = self._newest + (source + 1) * level.height + self._row
        self._slices = level.image.index_select(0, line * level.width + self._col)

    def at(self, shift: Tensor) -> Tensor:
        """(P,) uint8: which slices each template pixel shares with t+1. Args: shift: (K, 2) int64, (dy, dx)."""
        dy, dx = shift.index_select(0, self._job).unbind(1)
        row, col = self._row + dy, self._col + dx
        inside = (row >= 0) & (row < self._level.height) & (col >= 0) & (col < self._level.width)
        place = torch.where(inside, (self._newest + row) * self._level.width + col, self._level.image.numel() - 1)
        return self._slices & self._level.image.index_select(0, place)

    def count(self, matches: Tensor) -> Tensor:
        """(K,) int64, slices of each template among some (P,) uint8."""
        sums = torch.zeros(self._num_jobs, dtype=torch.int64, device=matches.device)
        return sums.index_add_(0, self._job, count_slices(matches).long())
