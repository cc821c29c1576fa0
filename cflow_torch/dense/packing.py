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
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import draw, take_columns
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
    """Search range of K images: dy in [-low_y, high_y], dx in [-low_x, high_x], up to the longest shift."""

    low: Tensor  # (2, K) int64, (y, x)
    high: Tensor  # (2, K) int64, (y, x)
    stride: Tensor  # (K,) int64, samples from one row of the image to the next, and so from one dy to the next
    longest_squared: Tensor | None  # (K,) float64, square of the length of the longest shift; None = no limit

    def __getitem__(self, images: Tensor | slice) -> Search:
        """Select images, (L,) int64 or a slice."""
        if isinstance(images, slice):
            ranges = (self.low[:, images], self.high[:, images])
        else:
            ranges = (take_columns(self.low, images), take_columns(self.high, images))
        longest = None if self.longest_squared is None else self.longest_squared[images]
        return Search(*ranges, self.stride[images], longest)

    def sample_at(self, shift: Tensor) -> Tensor:
        """(K,) int64, the sample of each image that belongs to a shift, (2, K) int64."""
        dy, dx = shift + self.low
        return dy * self.stride + dx

    def shift_at(self, sample: Tensor) -> Tensor:
        """(2, K) int64, the shift that belongs to a sample of each image, (K,) int64; may be beyond the range."""
        row = sample // self.stride
        return torch.stack((row, sample - row * self.stride)) - self.low

    def contains(self, shift: Tensor) -> Tensor:
        """(K,) bool, whether shifts that belong to samples, (2, K) int64, are in the range."""
        is_inside = (shift <= self.high).all(0)
        if self.longest_squared is None:
            return is_inside
        return is_inside & _is_short(shift, self.longest_squared)

    def clamp(self, shift: Tensor) -> Tensor:
        """(2, K) int64, shifts in the range: those that belong to samples, (2, K) int64, cut to it, or 0."""
        shift = torch.minimum(shift, self.high)
        if self.longest_squared is None:
            return shift
        return shift * _is_short(shift, self.longest_squared)


def _is_short(shift: Tensor, longest_squared: Tensor) -> Tensor:
    return (shift * shift).sum(0) <= longest_squared


@dataclass(frozen=True)
class ImageClass:
    """T templates and their M targets, all of one shape."""

    images: Tensor  # (T + M, Y, X) bool, first the templates
    target: Tensor  # (T,) int64, index of the target of each template among the M targets, ascending
    target_on_host: np.ndarray  # the same as an array
    num_searched: int  # number of leading samples that hold the search range
    max_energy: int  # largest number of set pixels of an image

    @property
    def area(self) -> int:
        """Number of samples in an image."""
        return self.images[0].numel()


@dataclass(frozen=True)
class Packing:
    """J templates and N targets. The packed order of the templates is by class, then by pair."""

    classes: list[ImageClass]
    pair: Tensor  # (J,) int64, pair of each packed template
    search: Search  # of the packed templates
    energy: Tensor  # (J + N,) int64, set pixels of the template of each pair, then of each target
    size: np.ndarray  # (N, 2) int64, height and width of each target


def pack(pairs: TemplatePairs) -> Packing:
    """Draw all templates and targets, by class.

    Raises:
        CFlowError: a cluster is too long or needs too much memory.
    """
    device = pairs.size.device
    num_pairs = len(pairs.cluster)
    image_of_pixel = torch.cat((pairs.template.image, pairs.target.image + num_pairs))
    energy = Groups(image_of_pixel, num_pairs + len(pairs.size)).size()
    numbers = _Numbers.of(pairs, energy)
    shapes = _Shapes.of(numbers, _LINES_CPU if device.type == "cpu" else _LINES_GPU)
    _check_size(numbers, shapes, device)
    layout = _Layout.of(numbers.cluster, shapes)

    images = torch.from_numpy(layout.images(shapes)).to(device)  # [2, J + N]
    buffer = _draw(pairs, take_columns(images, image_of_pixel), int(layout.num_samples.sum()))
    templates = layout.templates(numbers.cluster, shapes)  # [7, J]
    table = torch.from_numpy(templates).to(device)
    pair = table[0]
    longest_squared = None
    if pairs.radius is not None:
        longest_squared = (pairs.radius * pairs.radius).floor()[pair]
    return Packing(
        classes=_classes(layout, buffer, table[1], templates[1], shapes, numbers),
        pair=pair,
        search=Search(low=table[3:5], high=table[5:], stride=table[2], longest_squared=longest_squared),
        energy=energy,
        size=numbers.size,
    )


def _check_size(numbers: _Numbers, shapes: _Shapes, device: torch.device) -> None:
    """Raise an error if a cluster is too long, or if the images need too much memory."""
    longest = numbers.size.max()
    if longest > LONGEST_SIDE:
        raise CFlowError(
            f"a cluster is {longest} pixels long in one view (at most {LONGEST_SIDE}): is there a point far above "
            "or below? Give finite z bounds in point_cloud_range, or larger pixel_sizes"
        )
    area = shapes.area()
    require_memory(
        int(area[numbers.cluster].sum() + area.sum() + _BYTES_PER_SAMPLE * area.max()),
        device,
        f"a cluster that is {longest} pixels long",
        "give a max_speed, so that it is searched less far, a smaller point_cloud_range or larger pixel_sizes",
    )


def _draw(pairs: TemplatePairs, places: Tensor, num_samples: int) -> Tensor:
    """Draw all images into one buffer, (A,) bool; `places`, (2, P), has start and stride of the image of each pixel."""
    row = torch.cat((pairs.template.row, pairs.target.row))
    col = torch.cat((pairs.template.col, pairs.target.col))
    start, stride = places
    return draw(start + row * stride + col, num_samples)


class _Numbers(NamedTuple):
    """Numbers of the J pairs and N targets that decide on the layout; int64 arrays on the host."""

    cluster: np.ndarray  # (J,) target of each pair
    radius: np.ndarray  # (J,) longest shift that is searched, pixels
    energy: np.ndarray  # (J + N,) set pixels of all templates, then of all targets
    size: np.ndarray  # (N, 2) height and width

    @classmethod
    def of(cls, pairs: TemplatePairs, energy: Tensor) -> _Numbers:
        """Copy the numbers to the host at once."""
        radius = torch.full_like(pairs.cluster, LONGEST_SIDE)
        if pairs.radius is not None:
            radius = pairs.radius.clamp(max=LONGEST_SIDE).floor().long()
        parts = (pairs.cluster, radius, energy, pairs.size.flatten())
        ends = np.cumsum([len(part) for part in parts[:-1]])
        cluster, longest, set_pixels, size = np.split(as_numpy(torch.cat(parts)), ends)
        return cls(cluster, longest, set_pixels, size.reshape(-1, 2))


class _Shapes(NamedTuple):
    """Shapes of the images of N targets and of their templates; int64 arrays on the host."""

    low: np.ndarray  # (N, 2)
    high: np.ndarray  # (N, 2)
    height: np.ndarray  # (N,) Y
    length: np.ndarray  # (N,) X
    stride: np.ndarray  # (N,)

    @classmethod
    def of(cls, numbers: _Numbers, lines: Sequence[int]) -> _Shapes:
        """Choose the shape for the size of each target and the farthest shift of its pairs."""
        farthest = np.zeros((len(numbers.size), 1), np.int64)
        np.maximum.at(farthest[:, 0], numbers.cluster, numbers.radius)
        low = np.minimum(numbers.size // 2, farthest)
        high = np.minimum(numbers.size - 1 - numbers.size // 2, farthest)
        rows, width = (numbers.size + low).T
        is_line = rows * width <= lines[-1]
        height = np.where(is_line, 1, _at_least(FAST_LENGTHS, rows))
        length = np.where(is_line, _at_least(lines, rows * width), _at_least(FAST_LENGTHS, width))
        return cls(low, high, height, length, np.where(is_line, width, length))

    def area(self) -> np.ndarray:
        """(N,) number of samples of an image."""
        return self.height * self.length

    def num_searched(self) -> np.ndarray:
        """(N,) number of leading samples that hold the search range."""
        rows, cols = (self.low + self.high).T
        return rows * self.stride + cols + 1


class _Layout(NamedTuple):
    """Order of the J templates and N targets in one buffer; int64 arrays on the host.

    Class follows class. In a class, the templates come before the targets:

        class 0           class 1               t3 = template of pair 3
        t0 t3 T0 T2       t1 t2 t4 T1 T3        T2 = target 2
    """

    target: np.ndarray  # (J + N,) target of each image; the templates first, by pair
    image_class: np.ndarray  # (J + N,) class of each image, 0 ... C - 1
    order: np.ndarray  # (J + N,) images in the order of the buffer: 0 3 J+0 J+2 1 2 4 J+1 J+3
    num_templates: np.ndarray  # (C,)
    num_targets: np.ndarray  # (C,)
    height: np.ndarray  # (C,) Y
    length: np.ndarray  # (C,) X

    @classmethod
    def of(cls, cluster: np.ndarray, shapes: _Shapes) -> _Layout:
        """Order the images by their shapes; `cluster`, (J,), is the target of each template."""
        names, class_of_target = np.unique(shapes.height * _BASE + shapes.length, return_inverse=True)
        target = np.concatenate((cluster, np.arange(len(class_of_target))))
        image_class = class_of_target[target]
        is_target = np.arange(len(target)) >= len(cluster)
        return cls(
            target=target,
            image_class=image_class,
            order=np.argsort(2 * image_class + is_target, kind="stable"),
            num_templates=np.bincount(class_of_target[cluster], minlength=len(names)),
            num_targets=np.bincount(class_of_target),
            height=names // _BASE,
            length=names % _BASE,
        )

    @property
    def num_samples(self) -> np.ndarray:
        """(C,) number of samples of all images of each class."""
        return (self.num_templates + self.num_targets) * self.height * self.length

    def images(self, shapes: _Shapes) -> np.ndarray:
        """(2, J + N): sample of the first pixel, and stride, of the templates by pair, then of the targets."""
        end = shapes.area()[self.target[self.order]].cumsum()
        start = np.empty_like(end)
        start[self.order] = end - shapes.area()[self.target[self.order]]
        # The search range begins with shift (-low_y, -low_x), so targets are drawn that far from the corner.
        corner = shapes.low[:, 0] * shapes.stride + shapes.low[:, 1]
        start[-len(corner) :] += corner
        return np.stack((start, shapes.stride[self.target]))

    def templates(self, cluster: np.ndarray, shapes: _Shapes) -> np.ndarray:
        """(7, J), in packed order: pair, target in the class, stride, low y and x, high y and x of each template."""
        is_template = self.order < len(cluster)
        pair = self.order[is_template]
        target = self.order[~is_template] - len(cluster)
        index_in_class = np.empty_like(target)
        first = self.num_targets.cumsum() - self.num_targets
        index_in_class[target] = np.arange(len(target)) - np.repeat(first, self.num_targets)
        own = cluster[pair]
        ranges = (*shapes.low[own].T, *shapes.high[own].T)
        return np.stack((pair, index_in_class[own], shapes.stride[own], *ranges))


def _classes(
    layout: _Layout, buffer: Tensor, target: Tensor, target_on_host: np.ndarray, shapes: _Shapes, numbers: _Numbers
) -> list[ImageClass]:
    """Split the buffer, (A,) bool, and the targets of the packed templates, (J,) int64, by class."""
    num_classes = len(layout.height)
    num_searched = np.zeros(num_classes, np.int64)
    np.maximum.at(num_searched, layout.image_class[len(numbers.cluster) :], shapes.num_searched())
    max_energy = np.zeros(num_classes, np.int64)
    np.maximum.at(max_energy, layout.image_class, numbers.energy)
    columns = zip(
        buffer.split(layout.num_samples.tolist()),
        layout.height.tolist(),
        layout.length.tolist(),
        target.split(layout.num_templates.tolist()),
        np.split(target_on_host, layout.num_templates.cumsum()),
        num_searched.tolist(),
        max_energy.tolist(),
    )
    return [ImageClass(images.view(-1, height, length), *others) for images, height, length, *others in columns]


def _at_least(lengths: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Round each value up to one of the ascending lengths; larger values get the last one."""
    table = np.asarray(lengths)
    return table[np.searchsorted(table, values).clip(max=len(table) - 1)]
