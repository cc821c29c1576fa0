"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from typing import Iterator, List, NamedTuple, Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.dense.packing import Drawing, Images, Search, draw, search_bounds
from cflow_torch.ops.bits import popcount, unpack_bits
from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.exact import exact_sqrt
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_amin
from cflow_torch.ops.window_counts import WindowCounts

# Working memory of a job per sample of its class: spectra, counts, and what is looked up in them.
_BYTES_PER_SAMPLE = 48
# Samples of templates that are correlated together, and of correlations that are looked through together. On a CPU they
# are to stay in the cache (2^14 ... 2^26 were tried, docs/benchmarks); a GPU wants few launches.
_AT_ONCE_CPU, _IN_PART_CPU = 1 << 18, 1 << 21
_AT_ONCE_GPU, _IN_PART_GPU = 1 << 26, 1 << 26


class Correlation(NamedTuple):
    """Correlations of n jobs of a class.

    Args:
        counts: (n, Y * X) float, to be rounded.
        searched: number of leading samples that a shift may stand at.
    """

    counts: Tensor
    searched: int


def best_shifts(
    template: Images,
    target: Images,
    target_of_job: Tensor,
    size: Tensor,
    radius: Optional[Tensor] = None,
    engine: str = "fft",
    max_memory: Optional[int] = None,
    num_slices: int = 1,
) -> Tuple[Tensor, Tensor]:
    """The shift of each template that maximises the normalised cross-correlation with its target.

    Args:
        template: J images ("jobs").
        target: N images.
        target_of_job: (J,) int64, target of each template.
        size: (N, 2) int64, height and width H, W of each target and of its templates.
        radius: (J,) float64, longest shift that is searched, pixels; None = only bounded by the size.
        engine: "fft" or "conv"; the same bits.
        max_memory: bytes of working memory to plan with; more jobs than fit are processed in turn, with the same
            result. None = all jobs at once.
        num_slices: height slices of the images; all counts are sums over the slices.

    Returns:
        shift: (J, 2) int64, (dy, dx), pixels.
        score: (J,) float32, NCC at that shift, 0 ... 1.

    Convention:
        Searched are dy in [-(H // 2), H - 1 - H // 2] and dx likewise (u in [0, W) x [0, H) of Alg. scene_flow_1view).
        Ties: smallest |shift|, then smallest dy, then smallest dx. No overlap at all: shift 0, score 0.
        Counts are integers; they are compared as count^2 / energy in float64, so no device rounds differently.

    Cost: about area log(area) per job, area as searched; the only Python loop is over size classes.
    Source: Eq. norm_correlation, displacement_in_bev, Alg. scene_flow_1view.
    """
    num_jobs = target_of_job.numel()
    if num_jobs == 0:
        return size.new_zeros((0, 2)), torch.zeros(0, dtype=torch.float32, device=size.device)
    low, high = search_bounds(size, target_of_job, radius)
    search, drawing = draw(template, target, target_of_job, size, low, high, num_slices)
    jobs = drawing.jobs
    target_energy = target.energy(len(size))
    own = target_of_job.index_select(0, jobs)
    search, energy_of_job = search.take(own), target_energy.index_select(0, own)
    job_radius = None if radius is None else radius.index_select(0, jobs)

    found = []
    for part, counts in _correlated(drawing, own, engine, max_memory, num_slices):
        wanted = Search(search.low[part], search.high[part], search.stride[part])
        limit = None if job_radius is None else job_radius[part]
        job, *rest = _candidates(counts, wanted, energy_of_job[part], limit)
        found.append((job + part.start, *rest))
    place, dy, dx, count = found[0] if len(found) == 1 else map(torch.cat, zip(*found))
    job, job_target = jobs.index_select(0, place), own.index_select(0, place)
    weight = None if target.slices is None else popcount(target.slices)
    job, dy, dx, count, energy = _best_of_each_job(
        WindowCounts(target.image, target.row, target.col, size, weight), job, job_target, dy, dx, count, num_jobs
    )
    shift = torch.zeros((num_jobs, 2), dtype=torch.int64, device=size.device)
    shift[job] = torch.stack((dy, dx), 1)
    energies = template.energy(num_jobs).index_select(0, job) * energy
    score = torch.zeros(num_jobs, dtype=torch.float32, device=size.device)
    score[job] = (count.double() / exact_sqrt(energies.double())).float()
    return shift, score


def _correlated(
    drawing: Drawing, own: Tensor, engine: str, max_memory: Optional[int], num_slices: int
) -> Iterator[Tuple[slice, List[Correlation]]]:
    """Runs of jobs, in drawing order, and their correlations, class by class.

    Args:
        drawing: the images.
        own: (J,) int64, target of each job, in drawing order.
        engine, max_memory, num_slices: as for `best_shifts`.
    """
    place = torch.empty_like(drawing.targets)
    place.scatter_(0, drawing.targets, torch.arange(place.numel(), device=place.device))
    own = place.index_select(0, own)
    blocks = drawing.samples.split([(j + n) * y * x for j, n, y, x, _ in drawing.classes])
    at_once, in_part = _samples_at_once(own.device, max_memory)
    pending: List[Correlation] = []
    first_job = last_job = first_target = used = 0
    for block, (num_templates, num_targets, height, width, searched) in zip(blocks, drawing.classes):
        images = block.view(-1, height, width)
        step = max(1, at_once // (height * width * num_slices))
        for begin in range(0, num_templates, step):
            end = min(begin + step, num_templates)
            if pending and used + (end - begin) * searched > in_part:
                yield slice(first_job, last_job), pending
                pending, first_job, used = [], last_job, 0
            wanted = own[last_job : last_job + end - begin] - first_target
            some = images
            if end - begin < num_templates:  # a run of jobs needs a run of targets: both are in the order of clusters
                low, high = int(wanted.min()), int(wanted.max())
                some = torch.cat((images[begin:end], images[num_templates + low : num_templates + high + 1]))
                wanted = wanted - low
            counts = cross_correlate(_as_float(some, num_slices), end - begin, wanted, engine)
            pending.append(Correlation(counts.flatten(1), searched))
            last_job += end - begin
            used += (end - begin) * searched
        first_target += num_targets
    yield slice(first_job, last_job), pending


def _as_float(images: Tensor, num_slices: int) -> Tensor:
    """Zeros and ones, (K, Y, X) or (K, n, Y, X); from bool itself torch takes eight times as long."""
    if images.dtype == torch.uint8:
        return unpack_bits(images, num_slices)
    return images.view(torch.uint8).float()


def _samples_at_once(device: torch.device, max_memory: Optional[int]) -> Tuple[int, int]:
    """Samples of templates that are correlated together, and of correlations that are looked through together."""
    at_once, in_part = (_AT_ONCE_CPU, _IN_PART_CPU) if device.type == "cpu" else (_AT_ONCE_GPU, _IN_PART_GPU)
    if max_memory is not None:
        most = int(max_memory) // _BYTES_PER_SAMPLE
        at_once, in_part = min(at_once, most), min(in_part, most)
    return at_once, in_part


def _candidates(
    parts: List[Correlation], search: Search, target_energy: Tensor, radius: Optional[Tensor]
) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    """Shifts that may be the best of their job: (K,) job, dy, dx, count.

    A window holds at least the pixels that coincide and at most all of the target's, so count^2 / energy lies between
    count^2 / target energy and count. What is below the largest of the lower bounds need not be looked at.

    Args:
        parts: correlations of J jobs; what stands at samples outside the search is ignored.
        search: of each job.
        target_energy: (J,) int64, pixels of each job's target.
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
    # Which job and sample each place is: n jobs of a class have as many samples each.
    shape = [(len(part), part.shape[1]) for part in counts]
    table = torch.tensor([(n, width, n * width) for n, width in shape], device=place.device)
    ends = table[:, 2].cumsum(0)
    kind = torch.searchsorted(ends, place, right=True)
    first_job, width, first = torch.stack(
        (table[:, 0].cumsum(0) - table[:, 0], table[:, 1], ends - table[:, 2])
    ).index_select(1, kind)
    within = place - first
    in_class = within // width
    job, sample = first_job + in_class, within - in_class * width
    count = torch.cat(
        [
            part.counts.view(-1).index_select(0, rows * part.counts.shape[1] + samples)
            for part, rows, samples in zip(parts, *_split(place, ends, in_class, sample))
        ]
    )
    search = search.take(job)
    dy, dx = search.shift(sample)
    is_searched = (dy <= search.high[:, 0]) & (dx <= search.high[:, 1])
    if radius is not None:
        is_searched &= dy * dy + dx * dx <= square.index_select(0, job)
    kept = flat_nonzero(is_searched)
    job, dy, dx, count = (values.index_select(0, kept) for values in (job, dy, dx, count.round_().long()))
    return job, dy, dx, count


def _split(place: Tensor, ends: Tensor, *values: Tensor) -> List[Tuple[Tensor, ...]]:
    """Each of `values` in one piece per class."""
    stops = torch.searchsorted(place, ends).tolist()
    sizes = [stop - start for start, stop in zip([0, *stops], stops)]
    return [value.split(sizes) for value in values]


def _best_of_each_job(
    windows: WindowCounts, job: Tensor, target: Tensor, dy: Tensor, dx: Tensor, count: Tensor, num_jobs: int
) -> Tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The best candidate of each job that has one: (F,) job, dy, dx, count, energy; ties as in `best_shifts`.

    Args:
        windows: the targets; the energy of a shift (denominator of Eq. norm_correlation) is their pixels under the
            H x W window at that shift.
        job, target, dy, dx, count: (K,) int64, candidates.
        num_jobs: J.
    """
    # Bounds of the energy, cheap and close, leave few candidates. Division rounds monotonically: no winner is lost.
    least, most = windows.bounds(target, dy, dx)
    square = (count * count).double()
    bound = (square / most).new_zeros(num_jobs).scatter_reduce_(0, job, square / most, "amax")
    kept = flat_nonzero(square / torch.maximum(least, count) >= bound.index_select(0, job))
    job, target, dy, dx, count, square = (
        values.index_select(0, kept) for values in (job, target, dy, dx, count, square)
    )
    energy = windows.count(target, dy, dx)
    value = square / energy
    best_value = value.new_zeros(num_jobs).scatter_reduce_(0, job, value, "amax")
    tied = flat_nonzero(value == best_value.index_select(0, job))
    job, dy, dx, count, energy = (values.index_select(0, tied) for values in (job, dy, dx, count, energy))
    # One number that orders shifts: length, then dy, then dx. It fits: images have at most 2^15 pixels a side.
    span = 1 << 16
    order = ((dy * dy + dx * dx) * span + dy + span // 2) * span + dx + span // 2
    first = segment_amin(order, job, num_jobs, torch.iinfo(torch.int64).max)
    best = flat_nonzero(order == first.index_select(0, job))
    job, dy, dx, count, energy = (values.index_select(0, best) for values in (job, dy, dx, count, energy))
    return job, dy, dx, count, energy
