"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.packing import ImageClass, Packing, Search, pack
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.groups import FAR, Groups
from cflow_torch.ops.indices import draw, exceeds, flat_nonzero, gather, largest_of_rows, take_columns
from cflow_torch.ops.window_counts import WindowCounts
from cflow_torch.windows.bev_grid import LONGEST_SIDE

# Working memory of a pair per sample of its class: spectra, counts and tables.
_BYTES_PER_SAMPLE = 48
# Samples of templates in one call of the correlation. On a CPU they must fit the cache (we tried 2^14 ... 2^26). A GPU
# needs few launches.
_PER_CALL_CPU = 1 << 18
_PER_CALL_GPU = 1 << 26
# Searched samples of templates whose counts we compare in one go.
_PER_RUN_CPU = 1 << 21
_PER_RUN_GPU = 1 << 26
_EXACT_IN_FLOAT32 = 1 << 24


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
        displacements = displacement.new_zeros((*intervals.shape, displacement.shape[1]))
        scores = score.new_zeros(intervals.shape)
        slot = pairs.cluster * intervals.shape[1] + pairs.source
        displacements.flatten(0, 1).index_copy_(0, slot, displacement)
        scores.flatten().index_copy_(0, slot, score)
        available = draw(slot, intervals.numel()).view_as(intervals)
        return cls(displacements, scores, available, intervals)

    def per_interval(self) -> Tensor:
        """Displacement per sweep interval, (M, K, A) float64; undefined where not `available`."""
        return self.displacement / self.intervals[:, :, None]

    def newest_score(self) -> Tensor:
        """(M,) float32, score with the nearest sweep that has pixels of the cluster."""
        newest = self.available.int().argmax(1, keepdim=True)
        return self.score.gather(1, newest)[:, 0]


def correlate(clusters: Clusters, sweeps: ProjectedSweeps, config: DenseConfig) -> Estimates:
    """Estimate the displacement (z = 0) of every cluster from each earlier sweep to t+1 (Alg. scene_flow_1view)."""
    pixel_size = sweeps.grid.pixel_size
    pairs = make_pairs(clusters, sweeps.batch, pixel_size, config.max_speed)
    shift, score = best_shifts(pairs, config.correlation, config.max_memory)
    displacement = F.pad(shift.flip(1).double() * pixel_size, (0, 1))  # (dy, dx) -> (x, y, 0)
    return Estimates.of(pairs, displacement, score, sweeps.batch.elapsed[clusters.window, 1:])


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
    target = pairs.target
    windows = WindowCounts(target.image, target.row, target.col, packing.size, packing.energy[num_pairs:])
    limits = _Limits.of(pairs.size.device, max_memory)
    parts = [_candidates(counts, packing, pairs.cluster, windows) for counts in _correlate(packing, engine, limits)]
    candidates = _Candidates(torch.cat([part.columns for part in parts], 1))
    best = _best_of_each_pair(candidates, windows, num_pairs)
    return torch.stack((best.dy, best.dx), 1), best.score(packing.energy[:num_pairs])


class _Limits(NamedTuple):
    """How many samples we work on at once."""

    per_call: int  # samples of templates in one call of the correlation
    per_run: int  # searched samples whose counts we compare in one go

    @classmethod
    def of(cls, device: torch.device, max_memory: float | None) -> _Limits:
        """Choose what suits the device and the memory that we may use, bytes; None = no limit."""
        limits = cls(_PER_CALL_CPU, _PER_RUN_CPU) if device.type == "cpu" else cls(_PER_CALL_GPU, _PER_RUN_GPU)
        if max_memory is None:
            return limits
        most = int(max_memory) // _BYTES_PER_SAMPLE
        return cls(min(limits.per_call, most), min(limits.per_run, most))


@dataclass(frozen=True)
class _Counts:
    """Numbers of coinciding pixels of some packed templates, which follow each other.

    samples   0 0 0 0 | 1 1 1 1 | 2 2 2 2 2 2      two templates of a class and one of the next
    parts     [2, 4]              [1, 6]
    """

    templates: slice  # the n packed templates
    samples: Tensor  # (A,) float, whole numbers: the searched samples of one template after the other
    parts: list[Tensor]  # views of the samples, (templates, searched samples), one for each call of the correlation

    def ends(self) -> Tensor:
        """(n,) int64, number of samples up to the last one of each template."""
        lengths = [part.shape[1] for part in self.parts]
        repeats = [len(part) for part in self.parts]
        return torch.from_numpy(np.repeat(lengths, repeats).cumsum()).to(self.samples.device)

    def largest(self) -> Tensor:
        """(n,) int64, the sample of the largest count of each template, from its first sample on."""
        return torch.cat([largest_of_rows(part) for part in self.parts])

    def above(self, bounds: Tensor) -> Tensor:
        """Return the samples whose counts exceed the bound of their template, (n,) float: (K,) int64, ascending."""
        bounds_of_parts = bounds[:, None].split([len(part) for part in self.parts])
        return flat_nonzero(
            torch.cat([exceeds(part, bound).view(-1) for part, bound in zip(self.parts, bounds_of_parts)])
        )


def _correlate(packing: Packing, engine: str, limits: _Limits) -> Iterator[_Counts]:
    """Correlate all packed templates, as many at once as the limits allow."""
    max_energy = max(images.max_energy for images in packing.classes)
    dtype = torch.float32 if max_energy <= _EXACT_IN_FLOAT32 else torch.float64
    first = 0
    for run in _runs(packing.classes, limits):
        num_samples = [call.num_samples for call in run]
        samples = torch.empty(sum(num_samples), dtype=dtype, device=packing.pair.device)
        parts = [call.view(part) for call, part in zip(run, samples.split(num_samples))]
        for call, part in zip(run, parts):
            torch.round(call.correlate(engine).to(dtype), out=part)
        stop = first + sum(map(len, parts))
        yield _Counts(slice(first, stop), samples, parts)
        first = stop


def _runs(classes: list[ImageClass], limits: _Limits) -> Iterator[list[_Call]]:
    """Yield lists of calls within the limits, or of one call. A call is within the limits or has one template."""
    run: list[_Call] = []
    for images in classes:
        at_once = max(1, limits.per_call // images.area)
        for first in range(0, len(images.target), at_once):
            call = _Call(images, slice(first, min(first + at_once, len(images.target))))
            if run and sum(other.num_samples for other in run) + call.num_samples > limits.per_run:
                yield run
                run = []
            run.append(call)
    yield run


@dataclass(frozen=True)
class _Call:
    """A call of the correlation."""

    images: ImageClass
    templates: slice  # n templates of the class

    @property
    def num_samples(self) -> int:
        """Number of searched samples."""
        return self.images.num_searched * (self.templates.stop - self.templates.start)

    def view(self, samples: Tensor) -> Tensor:
        """View the samples of all templates, one after the other, as (n, searched samples)."""
        return samples.view(-1, self.images.num_searched)

    def correlate(self, engine: str) -> Tensor:
        """Count the coinciding pixels of templates and targets, (n, searched samples) float, nearly whole numbers."""
        num_templates = self.templates.stop - self.templates.start
        images = self.images.images
        target = self.images.target
        if num_templates < len(target):
            # Templates are in order of their targets, so they need a range of targets.
            first, last = self.images.target_on_host[[self.templates.start, self.templates.stop - 1]]
            images = torch.cat((images[self.templates], images[len(target) :][first : last + 1]))
            target = target[self.templates] - int(first)
        counts = cross_correlate(images, num_templates, target, engine, self.images.max_energy)
        return counts.flatten(1)[:, : self.images.num_searched]


def _candidates(counts: _Counts, packing: Packing, cluster: Tensor, windows: WindowCounts) -> _Candidates:
    """Find the shifts that may be the best of their pair; `cluster` is the target of each pair, (J,) int64.

    The value of a shift is count^2 / energy. We know the energy only within cheap bounds, and the count is one of them.
    A shift whose highest value is below the lowest value of another shift cannot win. We compare all shifts with two:
    shift 0, and the shift of the largest count, clamped to the search range. Division rounds monotonically, so no
    winner is lost.
    """
    templates = _Templates.of(counts, packing, cluster)
    least_value = _least_value(counts, templates, windows)  # [n]
    # We round the bound of the count down, because counts may be float32.
    bound = (least_value * (1 - 2.0**-20)).to(counts.samples.dtype)
    searched = _searched(counts, templates, counts.above(bound))  # [K]
    pair, target, value = gather(searched.template, templates.pair, templates.cluster, least_value)
    least, _ = windows.bounds(target, searched.shift)
    count = searched.count
    may_win = flat_nonzero((count * count).double() / torch.maximum(least, count) >= value)
    return _Candidates(take_columns(torch.stack((pair, target, *searched.shift, count)), may_win))


@dataclass(frozen=True)
class _Templates:
    """The n packed templates of some counts."""

    pair: Tensor  # (n,) int64
    cluster: Tensor  # (n,) int64, the target
    search: Search
    start: Tensor  # (n,) int64, first sample of each template
    end: Tensor  # (n,) int64, the one after its last sample

    @classmethod
    def of(cls, counts: _Counts, packing: Packing, cluster: Tensor) -> _Templates:
        """Select the templates of some counts; `cluster` is the target of each pair, (J,) int64."""
        pair = packing.pair[counts.templates]
        end = counts.ends()
        return cls(
            pair=pair,
            cluster=cluster.index_select(0, pair),
            search=packing.search[counts.templates],
            start=F.pad(end[:-1], (1, 0)),
            end=end,
        )


@dataclass(frozen=True)
class _Searched:
    """K shifts in the search range of their template."""

    template: Tensor  # (K,) int64
    count: Tensor  # (K,) int64, coinciding pixels
    shift: Tensor  # (2, K) int64, dy and dx


def _searched(counts: _Counts, templates: _Templates, sample: Tensor) -> _Searched:
    """Return the shifts of some samples that are in the search range of their template."""
    template = torch.searchsorted(templates.end, sample, right=True)
    search = templates.search[template]
    shift = search.shift_at(sample - templates.start.index_select(0, template))
    count = counts.samples.index_select(0, sample).long()
    columns = take_columns(torch.stack((template, count, *shift)), flat_nonzero(search.contains(shift)))
    return _Searched(columns[0], columns[1], columns[2:])


def _least_value(counts: _Counts, templates: _Templates, windows: WindowCounts) -> Tensor:
    """Return what the best shift of each of n templates is worth at least, (n,) float64."""
    search = templates.search
    peak = search.clamp(search.shift_at(counts.largest()))
    at_zero_and_peak = torch.stack((search.sample_at(torch.zeros_like(peak)), search.sample_at(peak)))
    samples = templates.start + at_zero_and_peak  # [2, n]
    _, most_at_peak = windows.bounds(templates.cluster, peak)
    most = torch.stack((windows.energy.index_select(0, templates.cluster), most_at_peak)).clamp(min=1)
    return (counts.samples[samples].double().square() / most).amax(0)


@dataclass(frozen=True)
class _Candidates:
    """K shifts that may be the best of their pair."""

    columns: Tensor  # (5, K) int64: pair, cluster, dy, dx, number of coinciding pixels

    @property
    def pair(self) -> Tensor:
        return self.columns[0]

    @property
    def cluster(self) -> Tensor:
        return self.columns[1]

    @property
    def shift(self) -> Tensor:
        return self.columns[2:4]

    @property
    def count(self) -> Tensor:
        return self.columns[4]


@dataclass(frozen=True)
class _Best:
    """The best shift of each pair, (J,) int64 each."""

    dy: Tensor
    dx: Tensor
    count: Tensor  # coinciding pixels
    energy: Tensor  # target pixels under the window

    def score(self, template_energy: Tensor) -> Tensor:
        """Return the NCC, (J,) float32, 0 where nothing overlaps; `template_energy`, (J,), counts template pixels."""
        energies = (template_energy * self.energy).clamp(min=1)
        return (self.count.double() / torch.sqrt(energies.double())).float()


def _best_of_each_pair(candidates: _Candidates, windows: WindowCounts, num_pairs: int) -> _Best:
    """Choose the best candidate of each pair, all 0 for a pair without candidates.

    The energy of a shift (denominator of Eq. norm_correlation) is the number of target pixels under the H x W window at
    that shift. Ties: as in `best_shifts`.
    """
    energy = windows.count(candidates.cluster, candidates.shift)
    value = (candidates.count * candidates.count).double() / energy
    of_pair = Groups(candidates.pair, num_pairs)
    is_best = value == of_pair.spread(of_pair.max(value, empty=0.0))
    dy, dx = candidates.shift
    # Among the best, the shortest shift wins, then the smallest dy, then the smallest dx.
    length = dy * dy + dx * dx
    of_pair = of_pair.where(is_best)
    of_pair = of_pair.where(length == of_pair.spread(of_pair.min(length, empty=FAR)))
    raster = dy * 2 * LONGEST_SIDE + dx
    of_pair = of_pair.where(raster == of_pair.spread(of_pair.min(raster, empty=FAR)))
    return _Best(*of_pair.sum(torch.stack((dy, dx, candidates.count, energy))))
