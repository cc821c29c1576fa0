"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.packing import ImageClass, Search, pack
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import flat_nonzero, largest_of_rows, split_index, take_columns
from cflow_torch.ops.window_counts import WindowCounts
from cflow_torch.windows.bev_grid import LONGEST_SIDE

# Working memory of a pair per sample of its class: spectra, counts and tables.
_BYTES_PER_SAMPLE = 48
# Samples of templates in one call of the correlation. On a CPU they must fit the cache (we tried 2^14 ... 2^26). A GPU
# needs few launches.
_PER_CALL_CPU = 1 << 18
_PER_CALL_GPU = 1 << 26


@dataclass(frozen=True)
class Estimates:
    """Motion of M clusters as estimated from each of K other sweeps, nearest sweep first."""

    # (M, K, A) float64, from the sweep to t+1: x, y and z in metres; in the verified method, y and x in finest pixels.
    displacement: Tensor
    score: Tensor  # (M, K) float32, NCC at the peak
    available: Tensor  # (M, K) bool, False = the cluster has no pixel in that sweep; displacement and score are 0 there
    intervals: Tensor  # (M, K) float64, sweep intervals from the sweep to t+1

    @classmethod
    def of(cls, pairs: TemplatePairs, displacement: Tensor, score: Tensor, intervals: Tensor) -> Estimates:
        """Collect the estimates of J pairs: `displacement` is (J, A), `score` is (J,), `intervals` is (M, K)."""
        (count, num_sources), num_axes = intervals.shape, displacement.shape[1]
        slot = torch.add(pairs.source, pairs.cluster, alpha=num_sources)
        displacements = displacement.new_zeros((count * num_sources, num_axes))
        scores = score.new_zeros(count * num_sources)
        available = torch.zeros_like(scores, dtype=torch.bool).index_fill_(0, slot, True)
        return cls(
            displacements.index_copy_(0, slot, displacement).view(count, num_sources, num_axes),
            scores.index_copy_(0, slot, score).view_as(intervals),
            available.view_as(intervals),
            intervals,
        )

    def per_interval(self) -> Tensor:
        """Displacement per sweep interval, (M, K, A) float64; undefined where not `available`."""
        return self.displacement / self.intervals[:, :, None]

    def newest_score(self) -> Tensor:
        """(M,) float32, score with the nearest sweep that has pixels of the cluster."""
        newest = self.available.int().argmax(1, keepdim=True)
        return self.score.gather(1, newest)[:, 0]


def correlate(clusters: Clusters, sweeps: ProjectedSweeps, config: DenseConfig) -> Estimates:
    """Estimate the displacement (z = 0) of every cluster from each earlier sweep to t+1 (Alg. scene_flow_1view)."""
    batch, pixel_size = sweeps.batch, sweeps.grid.pixel_size
    pairs = make_pairs(clusters, batch, pixel_size, config.max_speed)
    shift, score = best_shifts(pairs, config.correlation, config.max_memory)
    displacement = F.pad(shift.flip(1).double() * pixel_size, (0, 1))  # (dy, dx) -> (x, y, 0)
    return Estimates.of(pairs, displacement, score, batch.elapsed[clusters.window, 1:])


def best_shifts(pairs: TemplatePairs, engine: str = "fft", max_memory: float | None = None) -> tuple[Tensor, Tensor]:
    """Find the shift of each of J templates that maximises the normalised cross-correlation with its target.

    `max_memory` is the working memory that we may use, bytes; None = no limit. The result is identical for any memory,
    and for the engines "fft" and "conv".

    Returns:
        shift: (J, 2) int64, (dy, dx), pixels.
        score: (J,) float32, NCC at that shift, 0 ... 1.

    Convention:
        In a cluster's box of H x W pixels, the search range is dy in [-(H // 2), H - 1 - H // 2] and dx in
        [-(W // 2), W - 1 - W // 2], which is u in [0, W) x [0, H) of Alg. scene_flow_1view. Ties: smallest |shift|,
        then smallest dy, then smallest dx. Without any overlap the shift is 0 and the score 0. Counts are integers; we
        compare them as count^2 / energy in float64, so all devices agree.

    Cost: about A log(A) per pair, A = area of box plus search range. We loop in Python over size classes, in parts of
    limited size.
    Source: Eq. norm_correlation, displacement_in_bev, Alg. scene_flow_1view.
    """
    num_pairs = len(pairs.cluster)
    if num_pairs == 0:
        return pairs.cluster.new_zeros((0, 2)), torch.zeros(0, dtype=torch.float32, device=pairs.size.device)
    packing = pack(pairs)
    square = None if pairs.radius is None else (pairs.radius * pairs.radius).floor()  # (J,), of the longest shift
    target_energy = packing.energy.index_select(0, num_pairs + pairs.cluster)  # (J,)
    found = []
    for images in packing.classes:
        for some, counts in _correlate(images, engine, max_memory):
            pair = images.pair[some]
            longest = None if square is None else square[pair]
            needed = _least_count(packing.search[pair], counts, target_energy[pair], longest)
            row, sample = split_index(flat_nonzero(counts > needed[:, None]), counts.shape[1])
            found.append(torch.stack((pair[row], sample, counts[row, sample].long())))
    pair, sample, count = torch.cat(found, 1)  # [K]
    search = packing.search[pair]
    shift = search.shift_at(sample)
    is_searched = (shift <= search.high).all(0)
    if square is not None:
        is_searched &= (shift * shift).sum(0) <= square.index_select(0, pair)
    dy, dx = shift
    candidates = _Candidates(pair, pairs.cluster.index_select(0, pair), dy, dx, count).at(flat_nonzero(is_searched))
    target = pairs.target
    windows = WindowCounts(target.image, target.row, target.col, packing.size)
    best = _best_of_each_pair(candidates, windows, num_pairs)
    energies = (packing.energy[:num_pairs] * best.energy).clamp(min=1)  # 0 where nothing overlaps
    score = best.count.double() / torch.sqrt(energies.double())
    return torch.stack((best.dy, best.dx), 1), score.float()


@dataclass(frozen=True)
class _Candidates:
    """Shifts that may be the best of their pair, (K,) int64 each."""

    pair: Tensor
    cluster: Tensor
    dy: Tensor
    dx: Tensor
    count: Tensor  # coinciding pixels

    def at(self, index: Tensor) -> _Candidates:
        """Select some candidates."""
        columns = torch.stack((self.pair, self.cluster, self.dy, self.dx, self.count))
        return _Candidates(*take_columns(columns, index))


@dataclass(frozen=True)
class _Best:
    """The best shift of each pair, (J,) int64 each."""

    dy: Tensor
    dx: Tensor
    count: Tensor  # coinciding pixels
    energy: Tensor  # target pixels under the window


def _correlate(images: ImageClass, engine: str, max_memory: float | None) -> Iterator[tuple[slice, Tensor]]:
    """Yield some templates of a class, and their counts of coinciding pixels, (n, searched samples), whole numbers."""
    per_call = _PER_CALL_CPU if images.images.device.type == "cpu" else _PER_CALL_GPU
    if max_memory is not None:
        per_call = min(per_call, int(max_memory) // _BYTES_PER_SAMPLE)
    num_templates = len(images.pair)
    at_once = max(1, per_call // images.area)
    for first in range(0, num_templates, at_once):
        some = slice(first, min(first + at_once, num_templates))
        # Templates are in order of their targets, so they need a range of targets.
        low, high = images.target_on_host[[some.start, some.stop - 1]].tolist()
        targets = images.images[num_templates + low : num_templates + high + 1]
        called = torch.cat((images.images[some], targets)).float()
        target = images.target[some] - low
        counts = cross_correlate(called, some.stop - some.start, target, engine, images.max_energy)
        yield some, counts.flatten(1)[:, : images.num_searched].round_()


def _least_count(search: Search, counts: Tensor, target_energy: Tensor, square: Tensor | None) -> Tensor:
    """Return a bound that the count of the best shift of each pair exceeds, (n,) float.

    The energy of a window is at least the count and at most the energy of the target, so count^2 / energy lies between
    count^2 / target energy and count. A shift whose count is below such a lower bound of another shift cannot win. We
    take the bounds of two shifts: shift 0, and the shift of the largest count, clamped to the search range.

    Args:
        counts: (n, searched samples).
        target_energy: (n,) int64, pixels.
        square: (n,) float64, of the longest shift, pixels; None = no limit.
    """
    zero = torch.zeros_like(search.low)
    probe = torch.minimum(search.shift_at(largest_of_rows(counts)), search.high)
    if square is not None:
        probe = torch.where((probe * probe).sum(0) <= square, probe, zero)
    samples = torch.stack((search.sample_at(zero), search.sample_at(probe)), 1)  # [n, 2]
    largest = counts.gather(1, samples).amax(1)
    # We subtract 1, because the quotient is rounded. A count of 0 never beats shift 0.
    return (largest * largest / target_energy - 1).clamp(min=0.5)


def _best_of_each_pair(candidates: _Candidates, windows: WindowCounts, num_pairs: int) -> _Best:
    """Choose the best candidate of each pair, all 0 for a pair without candidates.

    The energy of a shift (denominator of Eq. norm_correlation) is the number of target pixels under the H x W window at
    that shift. Ties: as in `best_shifts`.
    """
    # Cheap bounds of the energy leave few candidates. Division rounds monotonically, so no winner is lost.
    least, most = windows.bounds(candidates.cluster, torch.stack((candidates.dy, candidates.dx)))
    square = (candidates.count * candidates.count).double()
    of_pair = Groups(candidates.pair, num_pairs)
    lower = of_pair.spread(of_pair.max(square / most, empty=0.0))
    candidates = candidates.at(flat_nonzero(square / torch.maximum(least, candidates.count) >= lower))

    energy = windows.count(candidates.cluster, torch.stack((candidates.dy, candidates.dx)))
    value = (candidates.count * candidates.count).double() / energy
    of_pair = Groups(candidates.pair, num_pairs)
    is_best = value == of_pair.spread(of_pair.max(value, empty=0.0))
    # Among the best, the shortest shift wins, then the smallest dy, then the smallest dx.
    length = candidates.dy * candidates.dy + candidates.dx * candidates.dx
    of_pair = of_pair.where(is_best)
    of_pair = of_pair.where(length == of_pair.spread(of_pair.min(length, empty=0)))
    raster = candidates.dy * 2 * LONGEST_SIDE + candidates.dx
    of_pair = of_pair.where(raster == of_pair.spread(of_pair.min(raster, empty=0)))
    return _Best(*of_pair.sum(torch.stack((candidates.dy, candidates.dx, candidates.count, energy))))
