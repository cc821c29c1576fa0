"""Displacement of every cluster by normalised cross-correlation, all clusters at once (Alg. scene_flow_1view)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Iterator, Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.cross_correlation import cross_correlate

# Clusters are correlated in size classes. Up to 64 px a few square classes: most clusters are small, and few classes
# mean few kernel launches. Longer clusters are rare, thin and expensive: height and width get classes of their own.
_SQUARE_CLASSES = (8, 16, 32, 64)
_LONG_CLASSES = (8, 16, 32, 48, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512, 640, 768, 1024)


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
) -> Tuple[Tensor, Tensor]:
    """The shift of each template that maximises the normalised cross-correlation with its target.

    Args:
        template: J images ("jobs").
        target: N images.
        target_of_job: (J,) int64, target of each template.
        size: (N, 2) int64, height and width H, W of each target and of its templates.
        radius: (J,) float64, longest shift that is searched, pixels; None = only bounded by the size.
        engine: "fft" or "conv"; the same bits.

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
    shift = torch.zeros((num_jobs, 2), dtype=torch.int64, device=size.device)
    score = torch.zeros(num_jobs, dtype=torch.float32, device=size.device)
    template_energy = torch.bincount(template.image, minlength=num_jobs)
    for (height, width), targets, jobs in _size_classes(size, target_of_job):
        target_images, number = _draw(target, targets, size.shape[0], height, width)
        template_images, _ = _draw(template, jobs, num_jobs, height, width)
        own_target = number[target_of_job[jobs]]
        counts = cross_correlate(template_images, target_images, own_target, engine)
        energy, searched = _window_energy(target_images, size[targets])
        if radius is not None:
            searched = searched[own_target] & _within(counts, radius[jobs])
        else:
            searched = searched[own_target]
        energy = energy[own_target]
        shift[jobs], peak_count, peak_energy = _argmax(counts, energy, searched)
        energies = (template_energy[jobs] * peak_energy).double()
        ncc = peak_count.double() / energies.clamp(min=1).sqrt()
        score[jobs] = ncc.float()
    return shift, score


def _size_classes(size: Tensor, target_of_job: Tensor) -> Iterator[Tuple[Tuple[int, int], Tensor, Tensor]]:
    """((height, width) of a class, its targets, its jobs), smallest class first."""
    if size.shape[0] == 0:
        return
    square = torch.tensor(_SQUARE_CLASSES, device=size.device)
    long = torch.tensor((*_LONG_CLASSES, int(size.max())), device=size.device)
    longer = size.amax(1, keepdim=True)
    small = square[torch.searchsorted(square, longer).clamp(max=len(square) - 1)].expand(-1, 2)
    large = long[torch.searchsorted(long[:-1].contiguous(), size)]
    classes, class_of_target = torch.unique(
        torch.where(longer <= _SQUARE_CLASSES[-1], small, large), dim=0, return_inverse=True
    )
    class_of_job = class_of_target[target_of_job]
    for index, shape in enumerate(classes.tolist()):
        yield (shape[0], shape[1]), (class_of_target == index).nonzero()[:, 0], (class_of_job == index).nonzero()[:, 0]


def _draw(images: Images, chosen: Tensor, num_images: int, height: int, width: int) -> Tuple[Tensor, Tensor]:
    """Some of the images as (n, height, width) bool, and (num_images,) int64 where each of them went, -1 = not drawn."""
    number = chosen.new_full((num_images,), -1)
    number[chosen] = torch.arange(chosen.numel(), device=chosen.device)
    place = number[images.image]
    inside = (place >= 0).nonzero()[:, 0]
    drawn = torch.zeros(chosen.numel() * height * width, dtype=torch.bool, device=chosen.device)
    drawn[(place[inside] * height + images.row[inside]) * width + images.col[inside]] = True
    return drawn.view(-1, height, width), number


def _window_energy(target: Tensor, size: Tensor) -> Tuple[Tensor, Tensor]:
    """Target pixels under the H x W window at every shift, and which shifts are searched.

    Args:
        target: (n, height, width) bool.
        size: (n, 2) int64, H and W of each image, at most height and width.

    Returns:
        energy: (n, Dy, Dx) int64, second factor of the denominator of Eq. norm_correlation, squared.
        searched: (n, Dy, Dx) bool.
    """
    energy = target.long()
    searched = []
    for axis in (1, 2):
        side, extent = target.shape[axis], size[:, axis - 1 : axis]
        shift = torch.arange(-(side // 2), side // 2 + 1, device=target.device)[None]
        half = extent // 2
        searched.append((shift >= -half) & (shift <= extent - 1 - half))
        # Pixels in [shift, shift + extent), that is before the end minus before the start, along this axis.
        before = torch.nn.functional.pad(energy.cumsum(axis), (1, 0) if axis == 2 else (0, 0, 1, 0))
        stop, start = (shift + extent).clamp(0, side), shift.clamp(min=0).expand(len(size), -1)
        expand = (lambda i: i[:, None, :].expand(-1, before.shape[1], -1)) if axis == 2 else (
            lambda i: i[:, :, None].expand(-1, -1, before.shape[2])
        )
        energy = before.gather(axis, expand(stop)) - before.gather(axis, expand(start))
    return energy, searched[0][:, :, None] & searched[1][:, None, :]


def _within(counts: Tensor, radius: Tensor) -> Tensor:
    """(J, Dy, Dx) bool, shifts of at most `radius` (J,) pixels."""
    return _squared_length(counts)[None].double() <= (radius * radius)[:, None, None]


def _squared_length(counts: Tensor) -> Tensor:
    """(Dy, Dx) int64, dy^2 + dx^2 of every shift of a count map."""
    dy, dx = (torch.arange(n, device=counts.device) - n // 2 for n in counts.shape[1:])
    return dy[:, None] ** 2 + dx[None] ** 2


def _argmax(counts: Tensor, energy: Tensor, searched: Tensor) -> Tuple[Tensor, Tensor, Tensor]:
    """Shift (J, 2) of the largest count^2 / energy, with the count and the energy there; ties as in `best_shifts`."""
    height, width = counts.shape[1:]
    value = (counts * counts).double() / energy.clamp(min=1).double()
    value = torch.where(searched, value, -1.0).flatten(1)
    rank = (_squared_length(counts) * (height * width)).flatten() + torch.arange(height * width, device=counts.device)
    tied = value == value.amax(1, keepdim=True)
    place = torch.where(tied, rank, torch.iinfo(torch.int64).max).amin(1) % (height * width)
    shift = torch.stack((place // width - height // 2, place % width - width // 2), 1)
    at = place[:, None]
    return shift, counts.flatten(1).gather(1, at)[:, 0], energy.flatten(1).gather(1, at)[:, 0]
