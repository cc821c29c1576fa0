"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.coarse_to_fine import ProjectedSweeps
from cflow_torch.dense.packing import Packing, Search, pack, shift_at
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.indices import flat_nonzero, largest_of_rows, take_columns
from cflow_torch.ops.segments import segment_amin
from cflow_torch.ops.window_counts import WindowCounts

# Working memory of a pair per sample of its class: spectra, counts and tables.
_BYTES_PER_SAMPLE = 48
# Samples of templates in one call of the correlation, and samples of counts in one run. On a CPU both must fit the
# cache (we tried 2^14 ... 2^26). A GPU needs few launches.
_PER_CALL_CPU, _PER_RUN_CPU = 1 << 18, 1 << 21
_PER_CALL_GPU, _PER_RUN_GPU = 1 << 26, 1 << 26


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
    num_pairs, device = pairs.cluster.numel(), pairs.size.device
    if num_pairs == 0:
        return pairs.cluster.new_zeros((0, 2)), torch.zeros(0, dtype=torch.float32, device=device)
    packing = pack(pairs)
    radius = None if pairs.radius is None else pairs.radius.index_select(0, packing.pairs)
    target_energy = packing.energy.index_select(0, packing.clusters + num_pairs)
    runs = _correlation_runs(packing, engine, max_memory)
    packed, dy, dx, count = torch.cat([_candidates(run, packing.search, target_energy, radius) for run in runs], 1)
    target = pairs.target
    dy, dx, count, energy = _best_of_each_pair(
        WindowCounts(target.image, target.row, target.col, packing.size),
        packing.pairs.index_select(0, packed),
        packing.clusters.index_select(0, packed),
        torch.stack((dy, dx)),
        count,
        num_pairs,
    )
    energies = (packing.energy[:num_pairs] * energy).clamp_(min=1)  # 0 where nothing overlaps
    return torch.stack((dy, dx), 1), (count.double() / torch.sqrt(energies.double())).float()


class _Run(NamedTuple):
    """Correlation counts of consecutive packed pairs."""

    pairs: slice  # the packed pairs
    counts: Tensor  # (A,) float, counts of all pairs, one pair after the other; the next run overwrites them
    pieces: list[Tensor]  # views of the counts, (pairs, searched samples), one for each call of the correlation


def _correlation_runs(packing: Packing, engine: str, max_memory: float | None) -> Iterator[_Run]:
    """Correlate all packed pairs, in runs that fit the cache or the memory."""
    device, classes = packing.samples.device, packing.classes
    per_call, per_run = (_PER_CALL_CPU, _PER_RUN_CPU) if device.type == "cpu" else (_PER_CALL_GPU, _PER_RUN_GPU)
    if max_memory is not None:
        per_call, per_run = (min(size, int(max_memory) // _BYTES_PER_SAMPLE) for size in (per_call, per_run))
    steps = [min(shape.templates, max(1, per_call // shape.area)) for shape in classes]
    size = max(per_run, *(step * shape.searched for step, shape in zip(steps, classes)))
    size = min(size, sum(shape.templates * shape.searched for shape in classes))
    dtype = torch.float32 if max(shape.max_energy for shape in classes) < 1 << 24 else torch.float64
    buffer = torch.empty(size, dtype=dtype, device=device)
    pieces: list[Tensor] = []
    first = pair = used = 0  # first pair of the run, next pair, samples used by the run
    blocks = packing.samples.split([(shape.templates + shape.targets) * shape.area for shape in classes])
    for block, shape, step in zip(blocks, classes, steps):
        images = block.view(-1, shape.height, shape.width)
        for begin in range(0, shape.templates, step):
            num_pairs = min(step, shape.templates - begin)
            stop = used + num_pairs * shape.searched
            if stop > len(buffer):
                yield _Run(slice(first, pair), buffer[:used], pieces)
                pieces, first, used, stop = [], pair, 0, stop - used
            called, target = images, packing.target[pair : pair + num_pairs]
            if num_pairs < shape.templates:  # pairs are in order of targets, so they need a range of targets
                low, high = packing.target_on_host[[pair, pair + num_pairs - 1]].tolist()
                targets = images[shape.templates + low : shape.templates + high + 1]
                called, target = torch.cat((images[begin : begin + num_pairs], targets)), target - low
            counts = cross_correlate(called.view(torch.uint8).float(), num_pairs, target, engine, shape.max_energy)
            piece = buffer[used:stop].view(num_pairs, -1)
            pieces.append(piece.copy_(counts.flatten(1)[:, : shape.searched]).round_())
            pair, used = pair + num_pairs, stop
    yield _Run(slice(first, pair), buffer[:used], pieces)


def _candidates(run: _Run, search: Search, target_energy: Tensor, radius: Tensor | None) -> Tensor:
    """Find the shifts that may be the best of their pair: (4, K) int64, packed pair, dy, dx, count.

    The energy of a window is at least the count and at most the energy of the target, so count^2 / energy lies between
    count^2 / target energy and count. A shift whose count is below such a lower bound of another shift cannot win.
    `target_energy`, (J,) int64, and `radius`, (J,) float64, are in pixels; no radius = no limit.
    """
    low, high, stride = search.low[:, run.pairs], search.high[:, run.pairs], search.stride[run.pairs]
    searched = search.searched[run.pairs]
    end = searched.cumsum(0)
    # Two shifts give a lower bound: shift 0, and the shift of the largest count, clamped to the search range.
    middle, largest = low[0] * stride + low[1], torch.cat([largest_of_rows(piece) for piece in run.pieces])
    dy, dx = torch.minimum(shift_at(largest, stride, low), high)
    probe = middle + dy * stride + dx
    if radius is not None:
        square = (radius[run.pairs] * radius[run.pairs]).floor()
        probe = torch.where(dy * dy + dx * dx <= square, probe, middle)
    start = end - searched
    bound = torch.maximum(run.counts.index_select(0, start + middle), run.counts.index_select(0, start + probe))
    # We subtract 1, because the quotient is rounded. A count of 0 never beats shift 0.
    needed = (bound * bound / target_energy[run.pairs] - 1).clamp_(min=0.5)[:, None]
    needed_of_piece = needed.split([len(piece) for piece in run.pieces])
    sample = flat_nonzero(torch.cat([(piece > least).view(-1) for piece, least in zip(run.pieces, needed_of_piece)]))
    pair = torch.searchsorted(end, sample, right=True)
    table = take_columns(torch.cat((low, high, stride[None], start[None])), pair)
    shift = shift_at(sample - table[5], table[4], table[:2])
    is_searched = (shift <= table[2:4]).all(0)
    if radius is not None:
        is_searched &= (shift * shift).sum(0) <= square.index_select(0, pair)
    found = torch.stack((pair + run.pairs.start, *shift, run.counts.index_select(0, sample).long()))
    return take_columns(found, flat_nonzero(is_searched))


def _best_of_each_pair(
    windows: WindowCounts, pair: Tensor, target: Tensor, shift: Tensor, count: Tensor, num_pairs: int
) -> Tensor:
    """Choose the best candidate of each pair: (4, J) int64, dy, dx, count, energy, all 0 for a pair without candidates.

    The energy of a shift (denominator of Eq. norm_correlation) is the number of target pixels under the H x W window at
    that shift. `pair`, `target` and `count`, (K,) int64, and `shift`, (2, K) int64, describe K candidates, in order of
    pair, dy and dx. Ties: as in `best_shifts`.
    """
    # Cheap bounds of the energy leave few candidates. Division rounds monotonically, so no winner is lost.
    parts = [windows.bounds(target[some], shift[:, some]) for some in chunks(0, len(pair), pair.device, 16)]
    least, most = (torch.cat(bounds) for bounds in zip(*parts)) if parts else (count, count)
    square = (count * count).double()
    bound = square.new_zeros(num_pairs).scatter_reduce_(0, pair, square / most, "amax")
    kept = flat_nonzero(square / torch.maximum(least, count) >= bound.index_select(0, pair))
    pair, target, dy, dx, count = take_columns(torch.stack((pair, target, *shift, count)), kept)
    energy = windows.count(target, torch.stack((dy, dx)))
    value = square.index_select(0, kept) / energy
    best_value = value.new_zeros(num_pairs).scatter_reduce_(0, pair, value, "amax")
    # One number orders shifts by length, then by position in the list, that is by dy, then dx. It fits an int64, as
    # images have at most 2^15 pixels a side.
    mask, none = (1 << 31) - 1, (1 << 62) + len(kept)
    order = torch.add(torch.arange(len(kept), device=pair.device), dy * dy + dx * dx, alpha=1 << 31)
    order.masked_fill_(value < best_value.index_select(0, pair), none)
    best = segment_amin(order, pair, num_pairs, none) & mask
    return take_columns(F.pad(torch.stack((dy, dx, count, energy)), (0, 1)), best)
