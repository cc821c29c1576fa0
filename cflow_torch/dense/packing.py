"""Templates and targets as images of few sizes, so that few batched transforms correlate all clusters.

An image is laid out as one line, whatever its height and width, and padded to one of a few lengths. A template of 2 x 3
pixels, searched up to 1 pixel up and down and 1 pixel to both sides (`low` = (1, 1), `stride` = 3 + 1):

    template         a b c .          target, from row 1 and column 1 on      . . . .
                     d e f .                                                  . A B C
                                                                              . D E F
    as lines         abc.def.....                                             .....ABC.DEF

Sample (dy + 1) * stride + (dx + 1) of their correlation is the number of pixels that coincide at shift (dy, dx). In the
search range, no other pair of pixels adds to this sample, neither across the end of a row nor across the end of a line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.dense.templates import TemplatePairs
from cflow_torch.ops.cross_correlation import FAST_LENGTHS
from cflow_torch.ops.indices import scatter_count, take_columns
from cflow_torch.types import CFlowError, as_numpy
from cflow_torch.windows.bev_grid import LONGEST_SIDE
from cflow_torch.windows.memory import require_memory

# Lengths of lines. Larger images are rare. They keep two dimensions, because their 2D transforms are cheaper, and have
# classes by height and width. On a GPU the lengths are farther apart, so that a batch of many windows has no more
# classes than one window.
_LINES_CPU = tuple(144 << k for k in range(8))  # square clusters of 8, 11, 16, ... 90 pixels
_LINES_GPU = tuple(144 << 2 * k for k in range(9))
# Spectra, counts and tables of the largest image, which is correlated alone.
_BYTES_PER_SAMPLE = 80
_BASE = 1 << 24  # a class is named by height * _BASE + width of its images


@dataclass(frozen=True)
class Search:
    """Search range of K images: dy in [-low_y, high_y], dx in [-low_x, high_x]."""

    low: Tensor  # (2, K) int64, (y, x)
    high: Tensor  # (2, K) int64, (y, x)
    stride: Tensor  # (K,) int64, samples from one row of the image to the next, and so from one dy to the next

    def __getitem__(self, some: Tensor) -> Search:
        """Select images, (L,) int64."""
        low = take_columns(self.low, some)
        return Search(low, take_columns(self.high, some), self.stride.index_select(0, some))

    def sample_at(self, shift: Tensor) -> Tensor:
        """(K,) int64, the sample of each image that belongs to a shift, (2, K) int64."""
        dy, dx = shift + self.low
        return dy * self.stride + dx

    def shift_at(self, sample: Tensor) -> Tensor:
        """(2, K) int64, the shift that belongs to a sample of each image, (K,) int64; invalid above `high`."""
        row = sample // self.stride
        return torch.stack((row, sample - row * self.stride)) - self.low


@dataclass(frozen=True)
class ImageClass:
    """T templates and their M targets, all of one shape."""

    images: Tensor  # (T + M, Y, X) bool, first the templates
    pair: Tensor  # (T,) int64, index of each template among all pairs, ascending
    target: Tensor  # (T,) int64, index of its target among the M targets, ascending
    target_on_host: np.ndarray  # the same as an array
    num_searched: int  # number of leading samples that hold the search range
    max_energy: int  # largest number of set pixels of an image

    @property
    def area(self) -> int:
        """Number of samples in an image."""
        return self.images[0].numel()


@dataclass(frozen=True)
class Packing:
    """J templates and N targets."""

    classes: list[ImageClass]
    search: Search  # of the J templates
    energy: Tensor  # (J + N,) int64, set pixels of all templates, then of all targets
    size: np.ndarray  # (N, 2) int64, height and width of all targets


class _Shapes(NamedTuple):
    """Shapes of the N targets and of their templates; arrays on the host."""

    low: np.ndarray  # (N, 2)
    high: np.ndarray  # (N, 2)
    height: np.ndarray  # (N,) Y
    length: np.ndarray  # (N,) X
    stride: np.ndarray  # (N,)

    @classmethod
    def of(cls, size: np.ndarray, farthest: np.ndarray, lines: Sequence[int]) -> _Shapes:
        """Choose the shapes of clusters of a size, (N, 2), that are searched up to `farthest` pixels, (N,)."""
        low = np.minimum(size // 2, farthest[:, None])
        high = np.minimum(size - 1 - size // 2, farthest[:, None])
        rows, width = (size + low).T
        is_line = rows * width <= lines[-1]
        height = np.where(is_line, 1, _at_least(FAST_LENGTHS, rows))
        length = np.where(is_line, _at_least(lines, rows * width), _at_least(FAST_LENGTHS, width))
        return cls(low, high, height, length, np.where(is_line, width, length))

    def num_searched(self) -> np.ndarray:
        """(N,) number of leading samples that hold the search range."""
        rows, cols = (self.low + self.high).T
        return rows * self.stride + cols + 1


def pack(pairs: TemplatePairs) -> Packing:
    """Draw all templates and targets, by class.

    Raises:
        CFlowError: a cluster is too long or needs too much memory.
    """
    device = pairs.size.device
    num_pairs = len(pairs.cluster)
    num_targets = len(pairs.size)
    image_of_pixel = torch.cat((pairs.template.image, pairs.target.image + num_pairs))
    energy = scatter_count(image_of_pixel, num_pairs + num_targets)
    size, cluster, energies, farthest = _to_host(pairs, energy)
    if size.max() > LONGEST_SIDE:
        raise CFlowError(
            f"a cluster is {size.max()} pixels long in one view (at most {LONGEST_SIDE}): is there a point far above "
            "or below? Give finite z bounds in point_cloud_range, or larger pixel_sizes"
        )
    shapes = _Shapes.of(size, farthest, _LINES_CPU if device.type == "cpu" else _LINES_GPU)
    area = shapes.height * shapes.length
    require_memory(
        int(area[cluster].sum() + area.sum() + _BYTES_PER_SAMPLE * area.max()),
        device,
        f"a cluster that is {size.max()} pixels long",
        "give a max_speed, so that it is searched less far, a smaller point_cloud_range or larger pixel_sizes",
    )

    # In the buffer, class follows class; templates come before targets. Templates have the class of their target.
    names, class_of_target = np.unique(shapes.height * _BASE + shapes.length, return_inverse=True)
    of_image = np.concatenate((cluster, np.arange(num_targets)))  # target of each image
    is_target = np.arange(len(of_image)) >= num_pairs
    order = np.argsort(2 * class_of_target[of_image] + is_target, kind="stable")
    end = area[of_image[order]].cumsum()
    start = np.empty_like(end)
    start[order] = end - area[of_image[order]]
    start[num_pairs:] += shapes.low[:, 0] * shapes.stride + shapes.low[:, 1]
    low = shapes.low[of_image].T
    high = shapes.high[of_image].T
    on_device = torch.from_numpy(np.stack((start, shapes.stride[of_image], *low, *high))).to(device)
    buffer = _draw(pairs, take_columns(on_device[:2], image_of_pixel), int(end[-1]))
    search = Search(low=on_device[2:4, :num_pairs], high=on_device[4:6, :num_pairs], stride=on_device[1, :num_pairs])

    classes = []
    first = 0
    for number, name in enumerate(names.tolist()):
        targets = np.flatnonzero(class_of_target == number)
        templates = np.flatnonzero(class_of_target[cluster] == number)
        height, length = divmod(name, _BASE)
        stop = first + (len(templates) + len(targets)) * height * length
        target = np.searchsorted(targets, cluster[templates])
        classes.append(
            ImageClass(
                images=buffer[first:stop].view(-1, height, length),
                pair=torch.from_numpy(templates).to(device),
                target=torch.from_numpy(target).to(device),
                target_on_host=target,
                num_searched=int(shapes.num_searched()[targets].max()),
                max_energy=int(max(energies[templates].max(initial=0), energies[num_pairs + targets].max())),
            )
        )
        first = stop
    return Packing(classes, search, energy, size)


def _to_host(pairs: TemplatePairs, energy: Tensor) -> tuple[np.ndarray, ...]:
    """Copy to the host at once: size (N, 2), cluster (J,), energy (J + N,), and the longest search of a target (N,)."""
    num_pairs = len(pairs.cluster)
    longest = torch.full_like(pairs.cluster, LONGEST_SIDE)
    if pairs.radius is not None:
        longest = pairs.radius.clamp(max=LONGEST_SIDE).floor().long()
    numbers = as_numpy(torch.cat((pairs.cluster, longest, energy, pairs.size.flatten())))
    cluster, radius, energies, size = np.split(numbers, np.cumsum((num_pairs, num_pairs, len(energy))))
    size = size.reshape(-1, 2)
    farthest = np.zeros(len(size), np.int64)
    np.maximum.at(farthest, cluster, radius)
    return size, cluster, energies, farthest


def _draw(pairs: TemplatePairs, layout: Tensor, num_samples: int) -> Tensor:
    """Draw all images into one buffer, (A,) bool; `layout`, (2, P), has start and stride of the image of each pixel."""
    row = torch.cat((pairs.template.row, pairs.target.row))
    col = torch.cat((pairs.template.col, pairs.target.col))
    start, stride = layout
    buffer = torch.zeros(num_samples, dtype=torch.bool, device=row.device)
    return buffer.index_fill_(0, start + row * stride + col, True)


def _at_least(lengths: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Round each value up to one of the ascending lengths; larger values get the last one."""
    table = np.asarray(lengths)
    return table[np.searchsorted(table, values).clip(max=len(table) - 1)]
