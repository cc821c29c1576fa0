"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.exact import exact_sqrt

# Clusters are correlated in size classes. Up to 64 px a few square classes: most clusters are small, and few classes
# mean few kernel launches. Longer clusters are rare, thin and expensive: height and width get classes of their own.
_SQUARE_CLASSES = (8, 16, 32, 64)
_LONG_CLASSES = (8, 16, 32, 48, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512, 640, 768, 1024)
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
    shape, class_of_target, class_shapes = _size_classes(size)
    class_of_job = class_of_target[target_of_job]
    targets, _, target_place = _draw(target, class_of_target, shape, class_shapes)
    templates, jobs, _ = _draw(template, class_of_job, shape[target_of_job], class_shapes)
    target_size = torch.empty_like(size).index_copy_(0, target_place, size)
    target_of_job = target_place[target_of_job[jobs]]  # from here on targets and jobs are sorted by class

    peaks = []
    first_target = first_job = 0
    for template_images, target_images in zip(templates, targets):
        own = target_of_job[first_job : first_job + len(template_images)] - first_target
        sizes = target_size[first_target : first_target + len(target_images)]
        limits = None if radius is None else radius[jobs[first_job : first_job + len(template_images)]]
        at_once = _jobs_at_once(template_images, max_memory)
        for start in range(0, len(template_images), at_once):
            part = slice(start, start + at_once)
            used, of_used = own[part], slice(None)
            if at_once < len(template_images):  # jobs are sorted by target: a run of jobs needs a run of targets
                of_used = slice(int(used[0]), int(used[-1]) + 1)
                used = used - used[0]
            limit = None if limits is None else limits[part]
            peaks.append(_peaks(template_images[part], target_images[of_used], used, sizes[of_used], limit, engine))
        first_target += len(target_images)
        first_job += len(template_images)

    shift, count, energy = (torch.empty_like(p).index_copy_(0, jobs, p) for p in map(torch.cat, zip(*peaks)))
    energies = (torch.bincount(template.image, minlength=num_jobs) * energy).double()
    return shift, (count.double() / exact_sqrt(energies.clamp(min=1))).float()


def _peaks(
    template: Tensor, target: Tensor, target_of_job: Tensor, size: Tensor, radius: Optional[Tensor], engine: str
) -> Tuple[Tensor, Tensor, Tensor]:
    """Shift, count and energy at the best shift of (J, height, width) templates over (n, height, width) targets."""
    counts = cross_correlate(template, target, target_of_job, engine)
    searched = _searched(target, size)[target_of_job]
    if radius is not None:
        searched = searched & (_squared_length(counts) <= (radius * radius)[:, None, None])
    return _argmax(counts, _energy_under_window(target, size)[target_of_job], searched)


def _jobs_at_once(template: Tensor, max_memory: Optional[int]) -> int:
    num_jobs, height, width = template.shape
    if max_memory is None:
        return num_jobs
    return max(1, min(num_jobs, int(max_memory) // (_BYTES_PER_SAMPLE * height * width)))


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


def _draw(
    images: Images, class_of_image: Tensor, shape: Tensor, class_shapes: List[Tuple[int, int]]
) -> Tuple[List[Tensor], Tensor, Tensor]:
    """Draw every image, sorted by size class.

    Returns:
        images: per class (n, height, width) bool.
        order: (N,) int64, images in the order in which they were drawn.
        place: (N,) int64, where in that order each image is.
    """
    order = torch.sort(class_of_image, stable=True).indices
    place = torch.empty_like(order).index_copy_(0, order, torch.arange(order.numel(), device=order.device))
    area = (shape[:, 0] * shape[:, 1])[order]
    start = (area.cumsum(0) - area)[place]
    counts = torch.bincount(class_of_image, minlength=len(class_shapes)).tolist()
    areas = [count * height * width for count, (height, width) in zip(counts, class_shapes)]
    pixel = start[images.image] + images.row * shape[images.image, 1] + images.col
    drawn = torch.zeros(sum(areas), dtype=torch.bool, device=pixel.device).index_fill_(0, pixel, True)
    return [part.view(-1, *hw) for part, hw in zip(drawn.split(areas), class_shapes)], order, place


def _shifts(side: int, device: torch.device) -> Tensor:
    """(2 (side // 2) + 1,) int64, all shifts along an axis of `side` pixels."""
    return torch.arange(-(side // 2), side // 2 + 1, device=device)


def _searched(images: Tensor, size: Tensor) -> Tensor:
    """(n, Dy, Dx) bool, the shifts of Alg. scene_flow_1view for images of (n, 2) `size` drawn as (n, height, width)."""
    half = size // 2
    low, high = -half, size - 1 - half
    rows, cols = (
        (shift >= low[:, axis, None]) & (shift <= high[:, axis, None])
        for axis, shift in enumerate((_shifts(images.shape[1], size.device), _shifts(images.shape[2], size.device)))
    )
    return rows[:, :, None] & cols[:, None, :]


def _energy_under_window(target: Tensor, size: Tensor) -> Tensor:
    """(n, Dy, Dx) int32, target pixels under the H x W window at every shift (denominator of Eq. norm_correlation)."""
    energy = target.int()
    for axis in (0, 1):
        energy = _sum_under_window(energy, size[:, axis, None]).transpose(1, 2)
    return energy


def _sum_under_window(values: Tensor, extent: Tensor) -> Tensor:
    """Sums of (n, side, m) `values` over rows [shift, shift + extent), for every shift: (n, D, m)."""
    side = values.shape[1]
    before = F.pad(values.cumsum(1, dtype=torch.int32), (0, 0, 1, 0))
    shift = _shifts(side, values.device)[None]
    stop, start = (shift + extent).clamp(0, side), shift.clamp(min=0).expand(len(extent), -1)
    rows = (index[:, :, None].expand(-1, -1, values.shape[2]) for index in (stop, start))
    stop_sum, start_sum = (before.gather(1, row) for row in rows)
    return stop_sum - start_sum


def _squared_length(counts: Tensor) -> Tensor:
    """(Dy, Dx) int64, dy^2 + dx^2 of every shift of a count map."""
    dy, dx = (_shifts(n - 1, counts.device) for n in counts.shape[1:])
    return dy[:, None] ** 2 + dx[None] ** 2


def _argmax(counts: Tensor, energy: Tensor, searched: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    """Shift (J, 2) of the largest count^2 / energy, with the count and the energy there; ties as in `best_shifts`."""
    height, width = counts.shape[1:]
    value = counts.double()
    value = value * value / energy.clamp(min=1)
    value = torch.where(searched, value, -1.0).flatten(1)
    order = (_squared_length(counts) * (height * width)).flatten() + torch.arange(height * width, device=counts.device)
    tied = value == value.amax(1, keepdim=True)
    place = torch.where(tied, order, torch.iinfo(torch.int64).max).amin(1) % (height * width)
    shift = torch.stack((place // width - height // 2, place % width - width // 2), 1)
    at = place[:, None]
    return shift, counts.flatten(1).gather(1, at)[:, 0], energy.flatten(1).gather(1, at)[:, 0]
