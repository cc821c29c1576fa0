"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, List, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.config import DenseConfig
from cflow_torch.dense.clustering import Clusters
from cflow_torch.dense.packing import Packing, Search, pack
from cflow_torch.dense.projection import ProjectedSweeps
from cflow_torch.dense.templates import TemplatePairs, make_pairs
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.indices import flat_nonzero
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


class Correlation(NamedTuple):
    """Correlations of n pairs of a class.

    Args:
        counts: (n, Y * X) float, to be rounded.
        searched: number of leading samples that a shift may stand at.
    """

    counts: Tensor
    searched: int


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


def best_shifts(pairs: TemplatePairs, engine: str = "fft", max_memory: Optional[float] = None) -> Tuple[Tensor, Tensor]:
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
    shift = torch.zeros((num_pairs, 2), dtype=torch.int64, device=device)
    score = torch.zeros(num_pairs, dtype=torch.float32, device=device)
    if num_pairs == 0:
        return shift, score
    search, packing = pack(pairs)
    order = packing.pairs
    own = pairs.cluster.index_select(0, order)
    search = search.take(own)
    target_energy = pairs.target.energy(len(pairs.size)).index_select(0, own)
    radius = None if pairs.radius is None else pairs.radius.index_select(0, order)

    found = []
    for part, counts in _correlated(packing, own, engine, max_memory):
        wanted = Search(search.low[part], search.high[part], search.stride[part])
        pair, *rest = _candidates(counts, wanted, target_energy[part], None if radius is None else radius[part])
        found.append((pair + part.start, *rest))
    place, dy, dx, count = found[0] if len(found) == 1 else map(torch.cat, zip(*found))
    target = pairs.target
    pair, dy, dx, count, energy = _best_of_each_pair(
        WindowCounts(target.image, target.row, target.col, pairs.size),
        order.index_select(0, place),
        own.index_select(0, place),
        dy,
        dx,
        count,
        num_pairs,
    )
    shift[pair] = torch.stack((dy, dx), 1)
    energies = pairs.template.energy(num_pairs).index_select(0, pair) * energy
    score[pair] = (count.double() / torch.sqrt(energies.double())).float()
    return shift, score


def _correlated(
    packing: Packing, own: Tensor, engine: str, max_memory: Optional[float]
) -> Iterator[Tuple[slice, List[Correlation]]]:
    """Runs of pairs, in packing order, and their correlations, class by class.

    Args:
        packing: the images.
        own: (J,) int64, target of each pair, in packing order.
        engine, max_memory: as for `best_shifts`.
    """
    place = torch.empty_like(packing.targets)
    place.scatter_(0, packing.targets, torch.arange(place.numel(), device=place.device))
    own = place.index_select(0, own)
    blocks = packing.samples.split([(j + n) * y * x for j, n, y, x, _ in packing.classes])
    at_once, in_part = _samples_at_once(own.device, max_memory)
    pending: List[Correlation] = []
    first_pair = last_pair = first_target = used = 0
    for block, (num_templates, num_targets, height, width, searched) in zip(blocks, packing.classes):
        images = block.view(-1, height, width)
        step = max(1, at_once // (height * width))
        for begin in range(0, num_templates, step):
            end = min(begin + step, num_templates)
            if pending and used + (end - begin) * searched > in_part:
                yield slice(first_pair, last_pair), pending
                pending, first_pair, used = [], last_pair, 0
            wanted = own[last_pair : last_pair + end - begin] - first_target
            some = images
            if end - begin < num_templates:  # a run of pairs needs a run of targets: both are in the order of clusters
                low, high = int(wanted.min()), int(wanted.max())
                some = torch.cat((images[begin:end], images[num_templates + low : num_templates + high + 1]))
                wanted = wanted - low
            counts = cross_correlate(some.view(torch.uint8).float(), end - begin, wanted, engine)
            pending.append(Correlation(counts.flatten(1), searched))
            last_pair += end - begin
            used += (end - begin) * searched
        first_target += num_targets
    yield slice(first_pair, last_pair), pending


def _samples_at_once(device: torch.device, max_memory: Optional[float]) -> Tuple[int, int]:
    """Samples of templates that are correlated together, and of correlations that are looked through together."""
    at_once, in_part = (_AT_ONCE_CPU, _IN_PART_CPU) if device.type == "cpu" else (_AT_ONCE_GPU, _IN_PART_GPU)
    if max_memory is not None:
        most = int(max_memory) // _BYTES_PER_SAMPLE
        at_once, in_part = min(at_once, most), min(in_part, most)
    return at_once, in_part


def _candidates(
    parts: List[Correlation], search: Search, target_energy: Tensor, radius: Optional[Tensor]
) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    """Shifts that may be the best of their pair: (K,) pair, dy, dx, count.

    A window holds at least the pixels that coincide and at most all of the target's, so count^2 / energy lies between
    count^2 / target energy and count. What is below the largest of the lower bounds need not be looked at.

    Args:
        parts: correlations of J pairs; what stands at samples outside the search is ignored.
        search: of each pair.
        target_energy: (J,) int64, pixels of each pair's target.
        radius: (J,) float64, pixels; None = no limit.
    """
    # Two samples for a lower bound: no shift, and the largest count, moved into the search if it stands outside.
    counts = [part.counts[:, : part.searched] for part in parts]
    largest = torch.cat([part.argmax(1) for part in counts])
    middle = search.low[:, 0] * search.stride + search.low[:, 1]
    dy, dx = search.shift(largest)
    dy, dx = torch.minimum(dy, search.high[:, 0]), torch.minimum(dx, search.high[:, 1])
    probe = middle + dy * search.stride + dx
    if radius is not None:
        square = (radius * radius).floor()
        probe = torch.where(dy * dy + dx * dx <= square, probe, middle)
    sizes = [len(part) for part in counts]
    probes = torch.stack((middle, probe), 1).split(sizes)
    bound = torch.cat([part.gather(1, places).amax(1) for part, places in zip(counts, probes)]).round_()
    # 1 less, because counts are not rounded yet; counts of 0 are never better than no shift at all.
    needed = (bound * bound / target_energy - 1).clamp_(min=0.5)[:, None].split(sizes)
    place = flat_nonzero(torch.cat([(part > least).flatten() for part, least in zip(counts, needed)]))
    # Which pair and sample each place is: n pairs of a class have as many samples each.
    shape = [(len(part), part.shape[1]) for part in counts]
    table = torch.tensor([(n, width, n * width) for n, width in shape], device=place.device)
    ends = table[:, 2].cumsum(0)
    kind = torch.searchsorted(ends, place, right=True)
    first_pair, width, first = torch.stack(
        (table[:, 0].cumsum(0) - table[:, 0], table[:, 1], ends - table[:, 2])
    ).index_select(1, kind)
    within = place - first
    in_class = within // width
    pair, sample = first_pair + in_class, within - in_class * width
    count = torch.cat(
        [
            part.counts.view(-1).index_select(0, rows * part.counts.shape[1] + samples)
            for part, rows, samples in zip(parts, *_split(place, ends, in_class, sample))
        ]
    )
    search = search.take(pair)
    dy, dx = search.shift(sample)
    is_searched = (dy <= search.high[:, 0]) & (dx <= search.high[:, 1])
    if radius is not None:
        is_searched &= dy * dy + dx * dx <= square.index_select(0, pair)
    kept = flat_nonzero(is_searched)
    pair, dy, dx, count = (values.index_select(0, kept) for values in (pair, dy, dx, count.round_().long()))
    return pair, dy, dx, count


def _split(place: Tensor, ends: Tensor, *values: Tensor) -> List[Tuple[Tensor, ...]]:
    """Each of `values` in one piece per class."""
    stops = torch.searchsorted(place, ends).tolist()
    sizes = [stop - start for start, stop in zip([0, *stops], stops)]
    return [value.split(sizes) for value in values]


def _best_of_each_pair(
    windows: WindowCounts, pair: Tensor, target: Tensor, dy: Tensor, dx: Tensor, count: Tensor, num_pairs: int
) -> Tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The best candidate of each pair that has one: (F,) pair, dy, dx, count, energy; ties as in `best_shifts`.

    Args:
        windows: the targets; the energy of a shift (denominator of Eq. norm_correlation) is their pixels under the
            H x W window at that shift.
        pair, target, dy, dx, count: (K,) int64, candidates.
        num_pairs: J.
    """
    # Bounds of the energy, cheap and close, leave few candidates. Division rounds monotonically: no winner is lost.
    least, most = windows.bounds(target, dy, dx)
    square = (count * count).double()
    bound = (square / most).new_zeros(num_pairs).scatter_reduce_(0, pair, square / most, "amax")
    kept = flat_nonzero(square / torch.maximum(least, count) >= bound.index_select(0, pair))
    pair, target, dy, dx, count, square = (
        values.index_select(0, kept) for values in (pair, target, dy, dx, count, square)
    )
    energy = windows.count(target, dy, dx)
    value = square / energy
    best_value = value.new_zeros(num_pairs).scatter_reduce_(0, pair, value, "amax")
    tied = flat_nonzero(value == best_value.index_select(0, pair))
    pair, dy, dx, count, energy = (values.index_select(0, tied) for values in (pair, dy, dx, count, energy))
    # One number that orders shifts: length, then dy, then dx. It fits: images have at most 2^15 pixels a side.
    span = 1 << 16
    order = ((dy * dy + dx * dx) * span + dy + span // 2) * span + dx + span // 2
    first = segment_amin(order, pair, num_pairs, torch.iinfo(torch.int64).max)
    best = flat_nonzero(order == first.index_select(0, pair))
    pair, dy, dx, count, energy = (values.index_select(0, best) for values in (pair, dy, dx, count, energy))
    return pair, dy, dx, count, energy
