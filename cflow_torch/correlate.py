"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.exact import exact_sqrt
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.ops.segments import segment_amin

# Clusters are correlated in size classes. Up to 64 px a few square classes: most clusters are small, and few classes
# mean few kernel launches. Longer clusters are rare, thin and expensive: height and width get classes of their own, in
# steps of at most an eighth.
_SQUARE_CLASSES = (8, 16, 32, 64)
_LONG_CLASSES = tuple(n << k for k in range(8) for n in range(8, 16))

# Working memory of a job per pixel of its class: spectra of 1.5 x 1.5 the size, counts, energies, ranking values.
_BYTES_PER_SAMPLE = 100


@dataclass(frozen=True)
class Images:
    """A set of small binary images, given by their set pixels.

    Args:
        image: (P,) int64, image of each pixel.
        row, col: (P,) int64, place inside the image, from 0.
    """

    image: Tensor
    row: Tensor
    col: Tensor


@dataclass(frozen=True)
class _Drawing:
    """Templates and targets as pixels, sorted by size class.

    Args:
        blocks: per class (J_c + N_c, height, width) float32 zeros and ones: its templates, then its targets.
        num_templates: per class J_c.
        jobs: (J,) int64, templates in the order in which they were drawn.
        targets: (N,) int64, targets in the order in which they were drawn.
    """

    blocks: List[Tensor]
    num_templates: List[int]
    jobs: Tensor
    targets: Tensor


def best_shifts(
    template: Images,
    target: Images,
    target_of_job: Tensor,
    size: Tensor,
    radius: Optional[Tensor] = None,
    engine: str = "fft",
    max_memory: Optional[int] = None,
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
            result. None = all jobs of a size class at once.

    Returns:
        shift: (J, 2) int64, (dy, dx), pixels.
        score: (J,) float32, NCC at that shift, 0 ... 1.

    Convention:
        Searched are dy in [-(H // 2), H - 1 - H // 2] and dx likewise (u in [0, W) x [0, H) of Alg. scene_flow_1view).
        Ties: smallest |shift|, then smallest dy, then smallest dx. No overlap at all: shift 0, score 0.
        Counts are integers; they are compared as count^2 / energy in float64, so no device rounds differently.

    Cost: about area log(area) per job; clusters are processed by size class, and the only Python loop is over classes.
    Source: Eq. norm_correlation, displacement_in_bev, Alg. scene_flow_1view.
    """
    num_jobs = target_of_job.numel()
    if num_jobs == 0:
        return size.new_zeros((0, 2)), torch.zeros(0, device=size.device)
    num_targets = len(size)
    drawing = _draw(template, target, target_of_job, size)
    # From here on jobs and targets are sorted by class.
    jobs, targets = drawing.jobs, drawing.targets
    place = torch.empty_like(targets).scatter_(0, targets, torch.arange(num_targets, device=size.device))
    of_job = place.index_select(0, target_of_job.index_select(0, jobs))
    target_energy = torch.bincount(target.image, minlength=num_targets).index_select(0, targets)
    target_size = size.index_select(0, targets)
    job_size, job_target_energy = target_size.index_select(0, of_job), target_energy.index_select(0, of_job)
    job_radius = None if radius is None else radius.index_select(0, jobs)

    candidates = []
    first_target = first_job = 0
    for block, num_templates in zip(drawing.blocks, drawing.num_templates):
        at_once = _jobs_at_once(block, num_templates, max_memory)
        for start in range(0, num_templates, at_once):
            stop = min(start + at_once, num_templates)
            part = slice(first_job + start, first_job + stop)
            images, own = block, of_job[part] - first_target
            if at_once < num_templates:  # jobs are sorted by target: a run of jobs needs a run of targets
                first, last = int(own[0]), int(own[-1])
                some_targets = block[num_templates + first : num_templates + last + 1]
                images, own = torch.cat((block[start:stop], some_targets)), own - first
            counts, dy, dx = cross_correlate(images, stop - start, own, engine)
            limit = None if job_radius is None else job_radius[part]
            job, *rest = _candidates(counts, dy, dx, job_size[part], job_target_energy[part], limit)
            candidates.append((job + part.start, *rest))
        first_target += len(block) - num_templates
        first_job += num_templates

    job, dy, dx, count = map(torch.cat, zip(*candidates))
    energy = _energy_under_window(drawing, of_job.index_select(0, job), job_size.index_select(0, job), dy, dx)
    best = _best_of_each_job(job, dy, dx, count, energy, num_jobs)
    found = jobs[job[best]]
    shift = torch.zeros((num_jobs, 2), dtype=torch.int64, device=size.device)
    shift[found] = torch.stack((dy[best], dx[best]), 1)
    energies = torch.bincount(template.image, minlength=num_jobs)[found] * energy[best]
    score = torch.zeros(num_jobs, dtype=torch.float32, device=size.device)
    score[found] = (count[best].double() / exact_sqrt(energies.double())).float()
    return shift, score


def _candidates(
    counts: Tensor, dy: Tensor, dx: Tensor, size: Tensor, target_energy: Tensor, radius: Optional[Tensor]
) -> Tuple[Tensor, Tensor, Tensor, Tensor]:
    """Shifts that may be the best of their job: (K,) job, dy, dx, count. Overwrites `counts`.

    A window holds at least the pixels that coincide and at most all of the target's, so count^2 / energy lies between
    count^2 / target energy and count. What is below the largest of the lower bounds need not be looked at.
    """
    half = size // 2
    low, high = -half, size - 1 - half
    in_rows = (dy >= low[:, :1]) & (dy <= high[:, :1])
    in_cols = (dx >= low[:, 1:]) & (dx <= high[:, 1:])
    counts.mul_(in_rows[:, :, None]).mul_(in_cols[:, None, :])
    if radius is not None:
        counts.mul_((dy[:, None] ** 2 + dx**2) <= (radius * radius)[:, None, None])
    largest = counts.amax((1, 2)).round()
    # 1 less, because counts are not rounded yet; counts of 0 are never better than no shift at all.
    needed = (largest * largest / target_energy - 1).clamp(min=0.5)
    place = flat_nonzero(counts > needed[:, None, None])
    num_rows, num_cols = counts.shape[1:]
    row = place // num_cols
    job = row // num_rows
    count = counts.view(-1).index_select(0, place).round().long()
    return job, dy.index_select(0, row - job * num_rows), dx.index_select(0, place - row * num_cols), count


def _energy_under_window(drawing: _Drawing, target: Tensor, size: Tensor, dy: Tensor, dx: Tensor) -> Tensor:
    """(K,) int64, target pixels under the H x W window at a shift (denominator of Eq. norm_correlation).

    Args:
        drawing: the images.
        target: (K,) int64, which target, in drawing order.
        size: (K, 2) int64, H, W.
        dy, dx: (K,) int64.
    """
    # Tables of the number of pixels above and to the left; counts below 2^24 are exact in float32.
    tables = [
        F.pad(block[first:].cumsum(1).cumsum(2), (1, 0, 1, 0))
        for block, first in zip(drawing.blocks, drawing.num_templates)
    ]
    table = torch.cat([part.flatten() for part in tables])
    shapes = torch.tensor([part.shape for part in tables], device=target.device)
    of_class = torch.repeat_interleave(shapes[:, 0])
    stride, area = shapes[of_class, 2], (shapes[:, 1] * shapes[:, 2])[of_class]
    start, stride = (area.cumsum(0) - area).index_select(0, target), stride.index_select(0, target)
    stop_y, stop_x = torch.minimum(size[:, 0] + dy, size[:, 0]), torch.minimum(size[:, 1] + dx, size[:, 1])
    begin_y, begin_x = dy.clamp(min=0), dx.clamp(min=0)
    above, below = start + begin_y * stride, start + stop_y * stride
    corners = torch.stack((below + stop_x, above + stop_x, below + begin_x, above + begin_x))
    stop_stop, begin_stop, stop_begin, begin_begin = table.take(corners)
    return (stop_stop - begin_stop - stop_begin + begin_begin).long()


def _best_of_each_job(job: Tensor, dy: Tensor, dx: Tensor, count: Tensor, energy: Tensor, num_jobs: int) -> Tensor:
    """(F,) int64, the best candidate of each job that has one; ties as in `best_shifts`."""
    value = count.double()
    value = value * value / energy
    best_value = value.new_zeros(num_jobs).scatter_reduce_(0, job, value, "amax")
    tied = flat_nonzero(value == best_value[job])
    # One number that orders shifts: length, then dy, then dx. It fits: images have at most 2^15 pixels a side.
    span = 1 << 16
    order = ((dy * dy + dx * dx) * span + dy + span // 2) * span + dx + span // 2
    order = order[tied]
    first = segment_amin(order, job[tied], num_jobs, torch.iinfo(torch.int64).max)
    return tied[order == first[job[tied]]]


def _jobs_at_once(block: Tensor, num_templates: int, max_memory: Optional[int]) -> int:
    if max_memory is None:
        return max(1, num_templates)
    return max(1, min(num_templates, int(max_memory) // (_BYTES_PER_SAMPLE * block.shape[1] * block.shape[2])))


def _draw(template: Images, target: Images, target_of_job: Tensor, size: Tensor) -> _Drawing:
    """Draw all templates and targets, each in the shape of its size class, in one go."""
    num_jobs = target_of_job.numel()
    shape, class_of_target, class_shapes = _size_classes(size)
    shape = torch.cat((shape.index_select(0, target_of_job), shape))
    kind = torch.cat((2 * class_of_target.index_select(0, target_of_job), 2 * class_of_target + 1))
    order = torch.sort(kind, stable=True).indices
    area = (shape[:, 0] * shape[:, 1]).index_select(0, order)
    start = torch.empty_like(area).scatter_(0, order, area.cumsum(0) - area)
    counts = torch.bincount(kind, minlength=2 * len(class_shapes)).tolist()

    image = torch.cat((template.image, target.image + num_jobs))
    row, col = torch.cat((template.row, target.row)), torch.cat((template.col, target.col))
    pixel = start.index_select(0, image) + row * shape[:, 1].index_select(0, image) + col
    shapes = [(a + b, *hw) for a, b, hw in zip(counts[::2], counts[1::2], class_shapes)]
    areas = [number * height * width for number, height, width in shapes]
    drawn = torch.zeros(sum(areas), dtype=torch.float32, device=pixel.device).index_fill_(0, pixel, 1.0)
    blocks = [part.view(of_class) for part, of_class in zip(drawn.split(areas), shapes)]
    is_job = order < num_jobs
    return _Drawing(blocks, counts[::2], order[is_job], order[~is_job] - num_jobs)


def _size_classes(size: Tensor) -> Tuple[Tensor, Tensor, List[Tuple[int, int]]]:
    """(N, 2) shape of the images that each target is drawn in, (N,) its class, and the shape of every class."""
    largest = int(size.max())
    square = torch.tensor(_SQUARE_CLASSES, device=size.device)
    long = torch.tensor([s for s in _LONG_CLASSES if s < largest] + [largest], device=size.device)
    longer = size.amax(1, keepdim=True)
    small = square[torch.searchsorted(square, longer).clamp(max=len(square) - 1)].expand(-1, 2)
    shape = torch.where(longer <= _SQUARE_CLASSES[-1], small, long[torch.searchsorted(long, size)])
    base = 1 + max(largest, _SQUARE_CLASSES[-1])
    keys, class_of_target = torch.unique(shape[:, 0] * base + shape[:, 1], return_inverse=True)
    return shape, class_of_target, [divmod(key, base) for key in keys.tolist()]
