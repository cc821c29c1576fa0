"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator

import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.packing import Packing, Search, pack
from cflow_torch.dense.projection import ProjectedSweeps
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.indices import flat_nonzero, largest_of_rows, take_columns
from cflow_torch.ops.segments import segment_amin
from cflow_torch.ops.window_counts import WindowCounts

# Working memory of a pair per sample of its class: spectra, counts, and what is looked up in them.
_BYTES_PER_SAMPLE = 48
# Samples of templates that are correlated together, and of correlations that are looked through together. On a CPU they
# are to stay in the cache (2^14 ... 2^26 were tried); a GPU wants few launches.
_AT_ONCE_CPU, _IN_PART_CPU = 1 << 18, 1 << 21
_AT_ONCE_GPU, _IN_PART_GPU = 1 << 26, 1 << 26


@dataclass(frozen=True)
class Estimates:
    """What every earlier sweep says of the motion of M clusters, nearest sweep first.

    Args:
        displacement: (M, K, 3) float64, metres m -> t+1.
        score: (M, K) float32, NCC at the peak.
        available: (M, K) bool, False = the cluster has no pixel in that sweep; both above are 0 there.
        intervals: (M, K) float64, sweep intervals from m to t+1.
    """

    displacement: Tensor
    score: Tensor
    available: Tensor
    intervals: Tensor

    def per_interval(self) -> Tensor:
        """(M, K, 3) float64, metres per sweep interval."""
        return self.displacement / self.intervals.clamp(min=1)[:, :, None]

    def newest_score(self) -> Tensor:
        """(M,) float32, that of the nearest sweep with the cluster."""
        newest = self.available.int().argmax(1, keepdim=True)
        return self.score.gather(1, newest)[:, 0]


def correlate(clusters: Clusters, sweeps: ProjectedSweeps, config: DenseConfig) -> Estimates:
    """Displacement m -> t+1 of every cluster for every earlier sweep m (Alg. scene_flow_1view, view = BEV).

    Args:
        clusters: of the sweeps.
        sweeps: for the elapsed time of each sweep and the pixel size.
        config: `max_speed`, `correlation`, `max_memory`.

    Returns:
        The estimates; z is 0.
    """
    batch, pixel_size = sweeps.batch, sweeps.grid.pixel_size
    pairs = make_pairs(clusters, batch, pixel_size, config.max_speed)
    shift, score = best_shifts(pairs, config.correlation, config.max_memory)
    shape = (clusters.window.numel(), batch.num_steps - 1)
    displacement = torch.zeros((*shape, 3), dtype=torch.float64, device=shift.device)
    scores = torch.zeros(shape, dtype=torch.float32, device=shift.device)
    available = torch.zeros(shape, dtype=torch.bool, device=shift.device)
    displacement[pairs.cluster, pairs.source, :2] = shift.flip(1).double() * pixel_size  # (dy, dx) -> (x, y)
    scores[pairs.cluster, pairs.source] = score
    available[pairs.cluster, pairs.source] = True
    return Estimates(displacement, scores, available, batch.elapsed[clusters.window, 1:])


def best_shifts(pairs: TemplatePairs, engine: str = "fft", max_memory: float | None = None) -> tuple[Tensor, Tensor]:
    """The shift of each template that maximises the normalised cross-correlation with its target.

    Args:
        pairs: J of them.
        engine: "fft" or "conv"; the same result.
        max_memory: bytes of working memory to plan with; more pairs than fit are processed in turn, with the same
            result. None = all at once.

    Returns:
        shift: (J, 2) int64, (dy, dx), pixels.
        score: (J,) float32, NCC at that shift, 0 ... 1.

    Convention:
        Searched are dy in [-(H // 2), H - 1 - H // 2] and dx likewise (u in [0, W) x [0, H) of Alg. scene_flow_1view).
        Ties: smallest |shift|, then smallest dy, then smallest dx. No overlap at all: shift 0, score 0.
        Counts are integers; they are compared as count^2 / energy in float64, so no device rounds differently.

    Cost: about area log(area) per pair, area as searched; the only Python loop is over size classes.
    Source: Eq. norm_correlation, displacement_in_bev, Alg. scene_flow_1view.
    """
    num_pairs, device = pairs.cluster.numel(), pairs.size.device
    if num_pairs == 0:
        return pairs.cluster.new_zeros((0, 2)), torch.zeros(0, dtype=torch.float32, device=device)
    packing = pack(pairs)
    radius = None if pairs.radius is None else pairs.radius.index_select(0, packing.pairs)
    target_energy = packing.energy.index_select(0, packing.clusters + num_pairs)
    found = [
        _candidates(*run, packing.search, target_energy, radius) for run in _correlated(packing, engine, max_memory)
    ]
    place, dy, dx, count = torch.cat(found, 1)
    target = pairs.target
    dy, dx, count, energy = _best_of_each_pair(
        WindowCounts(target.image, target.row, target.col, packing.size),
        packing.pairs.index_select(0, place),
        packing.clusters.index_select(0, place),
        torch.stack((dy, dx)),
        count,
        num_pairs,
    )
    energies = (packing.energy[:num_pairs] * energy).clamp_(min=1)  # 0 where nothing overlaps
    return torch.stack((dy, dx), 1), (count.double() / torch.sqrt(energies.double())).float()


def _correlated(
    packing: Packing, engine: str, max_memory: float | None
) -> Iterator[tuple[slice, Tensor, list[Tensor]]]:
    """Runs of packed pairs, their searched counts, one pair after the other, and the same as (n, searched) pieces.

    The counts of a run are overwritten by those of the next.
    """
    device, classes = packing.samples.device, packing.classes
    blocks = packing.samples.split([(found.templates + found.targets) * found.area for found in classes])
    at_once, in_part = _samples_at_once(device, max_memory)
    steps = [min(found.templates, max(1, at_once // found.area)) for found in classes]
    size = max(in_part, *(step * found.searched for step, found in zip(steps, classes)))
    size = min(size, sum(found.templates * found.searched for found in classes))
    dtype = torch.float32 if max(found.most for found in classes) < 1 << 24 else torch.float64
    samples = torch.empty(size, dtype=dtype, device=device)
    pieces: list[Tensor] = []
    first_pair = last_pair = used = 0
    for block, found, step in zip(blocks, classes, steps):
        images = block.view(-1, found.height, found.width)
        own = packing.own_on_host[last_pair : last_pair + found.templates]
        for begin in range(0, found.templates, step):
            end = min(begin + step, found.templates)
            wanted, some, stop = own[begin:end], images, used + (end - begin) * found.searched
            if stop > len(samples):
                yield slice(first_pair, last_pair), samples[:used], pieces
                pieces, first_pair, used, stop = [], last_pair, 0, stop - used
            target = packing.own[last_pair : last_pair + end - begin]
            # A run of pairs needs a run of targets: both are in the order of clusters.
            if end - begin < found.templates:
                targets = images[found.templates + wanted[0] : found.templates + wanted[-1] + 1]
                target, some = target - int(wanted[0]), torch.cat((images[begin:end], targets))
            counts = cross_correlate(some.view(torch.uint8).float(), end - begin, target, engine, found.most)
            piece = samples[used:stop].view(end - begin, -1)
            pieces.append(piece.copy_(counts.flatten(1)[:, : found.searched]).round_())
            last_pair, used = last_pair + end - begin, stop
    yield slice(first_pair, last_pair), samples[:used], pieces


def _samples_at_once(device: torch.device, max_memory: float | None) -> tuple[int, int]:
    """Samples of templates that are correlated together, and of correlations that are looked through together."""
    at_once, in_part = (_AT_ONCE_CPU, _IN_PART_CPU) if device.type == "cpu" else (_AT_ONCE_GPU, _IN_PART_GPU)
    if max_memory is not None:
        most = int(max_memory) // _BYTES_PER_SAMPLE
        at_once, in_part = min(at_once, most), min(in_part, most)
    return at_once, in_part


def _candidates(
    part: slice,
    samples: Tensor,
    pieces: list[Tensor],
    search: Search,
    target_energy: Tensor,
    radius: Tensor | None,
) -> Tensor:
    """Shifts that may be the best of their pair: (4, K) int64, packed pair, dy, dx, count.

    A window holds at least the pixels that coincide and at most all of the target's, so count^2 / energy lies between
    count^2 / target energy and count. What is below the largest of the lower bounds need not be looked at.

    Args:
        part: the pairs that are looked at.
        samples, pieces: of these pairs, as `_correlated` gives them; samples outside the search are ignored.
        search: of each packed pair.
        target_energy: (J,) int64, pixels of each pair's target.
        radius: (J,) float64, pixels; None = no limit.
    """
    low, high, stride = search.low[:, part], search.high[:, part], search.stride[part]
    searched = search.searched[part]
    end = searched.cumsum(0)
    # Two samples for a lower bound: no shift, and the largest count, moved into the search if it stands outside.
    middle, largest = low[0] * stride + low[1], torch.cat([largest_of_rows(piece) for piece in pieces])
    dy, dx = torch.minimum(Search(low, high, stride, searched).shift(largest), high)
    probe = middle + dy * stride + dx
    if radius is not None:
        square = (radius[part] * radius[part]).floor()
        probe = torch.where(dy * dy + dx * dx <= square, probe, middle)
    start = end - searched
    bound = torch.maximum(samples.index_select(0, start + middle), samples.index_select(0, start + probe))
    # 1 less, because the quotient is rounded; counts of 0 are never better than no shift at all.
    needed = (bound * bound / target_energy[part] - 1).clamp_(min=0.5)[:, None].split([len(piece) for piece in pieces])
    place = flat_nonzero(torch.cat([(piece > least).view(-1) for piece, least in zip(pieces, needed)]))
    pair = torch.searchsorted(end, place, right=True)
    found = take_columns(torch.cat((low, high, stride[None], start[None])), pair)
    shift = Search(found[:2], found[2:4], found[4], found[5]).shift(place - found[5])
    is_searched = (shift <= found[2:4]).all(0)
    if radius is not None:
        is_searched &= (shift * shift).sum(0) <= square.index_select(0, pair)
    found = torch.stack((pair + part.start, *shift, samples.index_select(0, place).long()))
    return take_columns(found, flat_nonzero(is_searched))


def _best_of_each_pair(
    windows: WindowCounts, pair: Tensor, target: Tensor, shift: Tensor, count: Tensor, num_pairs: int
) -> Tensor:
    """The best candidate of each pair: (4, J) int64, dy, dx, count, energy, all 0 without any; ties as in
    `best_shifts`.

    Args:
        windows: the targets; the energy of a shift (denominator of Eq. norm_correlation) is their pixels under the
            H x W window at that shift.
        pair, target, count: (K,) int64, candidates.
        shift: (2, K) int64, their dy and dx.
        num_pairs: J.
    """
    # Bounds of the energy, cheap and close, leave few candidates. Division rounds monotonically: no winner is lost.
    parts = [windows.bounds(target[some], shift[:, some]) for some in chunks(0, len(pair), pair.device, 16)]
    least, most = (torch.cat(bounds) for bounds in zip(*parts)) if parts else (count, count)
    square = (count * count).double()
    bound = square.new_zeros(num_pairs).scatter_reduce_(0, pair, square / most, "amax")
    kept = flat_nonzero(square / torch.maximum(least, count) >= bound.index_select(0, pair))
    pair, target, dy, dx, count = take_columns(torch.stack((pair, target, *shift, count)), kept)
    energy = windows.count(target, torch.stack((dy, dx)))
    value = square.index_select(0, kept) / energy
    best_value = value.new_zeros(num_pairs).scatter_reduce_(0, pair, value, "amax")
    # One number that orders shifts: length, then dy, then dx. It fits: images have at most 2^15 pixels a side.
    span, last = 1 << 16, torch.iinfo(torch.int64).max
    order = ((dy * dy + dx * dx) * span + dy + span // 2) * span + dx + span // 2
    order.masked_fill_(value < best_value.index_select(0, pair), last)
    first = segment_amin(order, pair, num_pairs, last)
    best = torch.zeros((4, num_pairs + 1), dtype=torch.int64, device=pair.device)  # the last one is for the others
    best[:, torch.where(order == first.index_select(0, pair), pair, num_pairs)] = torch.stack((dy, dx, count, energy))
    return best[:, :num_pairs]
