"""Templates and targets packed into one buffer, so that one correlation per size class finds all shifts."""

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

# We lay out an image as one line, whatever its height and width, and pad it to the next of these lengths. So the many
# small clusters have few size classes and need few kernel launches. Images too large for a line are rare. They keep two
# dimensions, because their 2D transforms are cheaper, and have classes by height and width. On a GPU the lengths are
# farther apart, so that a batch of many windows has no more classes than one window.
_LINES_CPU = tuple(144 << k for k in range(8))  # square clusters of 8, 11, 16, ... 90 pixels
_LINES_GPU = tuple(144 << 2 * k for k in range(9))
# Spectra, counts and tables of the largest image, which is correlated alone.
_BYTES_PER_SAMPLE = 80
# A class is named by height * _BASE + width of its images.
_BASE = 1 << 24


@dataclass(frozen=True)
class Search:
    """Search range of each of K images: dy in [-low_y, high_y], dx in [-low_x, high_x]."""

    low: Tensor  # (2, K) int64, (y, x)
    high: Tensor  # (2, K) int64, (y, x)
    stride: Tensor  # (K,) int64, samples from one row of the image to the next, and so from one dy to the next
    # (K,) int64, number of leading samples that hold the search range; equal for all images of a class.
    searched: Tensor


def shift_at(sample: Tensor, stride: Tensor, low: Tensor) -> Tensor:
    """(2, K) int64, dy and dx of sample number `sample`, (K,) int64, of each image; invalid above `Search.high`."""
    row = sample // stride
    return torch.stack((row, sample - row * stride)) - low


class SizeClass(NamedTuple):
    """Images of one shape."""

    templates: int  # number of templates
    targets: int  # number of targets
    height: int  # Y, rows of an image in samples
    width: int  # X, columns of an image in samples
    searched: int  # number of leading samples that hold the search range
    max_energy: int  # largest number of set pixels of an image

    @property
    def area(self) -> int:
        """Number of samples in an image."""
        return self.height * self.width


@dataclass(frozen=True)
class Packing:
    """J templates and N targets, padded to their size class. Class follows class, with its templates first."""

    samples: Tensor  # (A,) bool, all images
    classes: list[SizeClass]  # size classes, in order
    target: Tensor  # (J,) int64, target of each packed pair, counted through the targets of its class
    target_on_host: np.ndarray  # `target` as a NumPy array
    search: Search  # search range of each packed pair
    pairs: Tensor  # (J,) int64, index of each packed pair among the pairs given
    clusters: Tensor  # (J,) int64, target of each packed pair, counted through the targets given
    energy: Tensor  # (J + N,) int64, set pixels of all templates, then of all targets, in the order given
    size: np.ndarray  # (N, 2) int64, height and width of all targets, as an array


def pack(pairs: TemplatePairs) -> Packing:
    """Pack all templates and targets. A cluster that is too long or needs too much memory is a `CFlowError`.

    An image takes H + low_y rows of W + low_x samples, and a target begins at row low_y and column low_x. Then sample
    (dy + low_y) * stride + dx + low_x of the correlation belongs to shift (dy, dx). In the search range, no other pair
    of pixels adds to this sample, neither across the end of a row nor across the end of the image.
    """
    device, num_pairs, num_targets = pairs.size.device, len(pairs.cluster), len(pairs.size)
    template, target = pairs.template, pairs.target
    image = torch.cat((template.image, target.image + num_pairs))
    energy = scatter_count(image, num_pairs + num_targets)
    reach = () if pairs.radius is None else (pairs.radius.clamp(max=LONGEST_SIDE).floor().long(),)
    numbers = as_numpy(torch.cat((pairs.size.flatten(), pairs.cluster, energy, *reach)))  # one copy to the host
    size, numbers = numbers[: 2 * num_targets].reshape(-1, 2), numbers[2 * num_targets :]
    cluster, energies, farthest = np.split(numbers, np.cumsum((num_pairs, num_pairs + num_targets)))
    if size.max() > LONGEST_SIDE:
        raise CFlowError(
            f"a cluster is {size.max()} pixels long in one view (at most {LONGEST_SIDE}): is there a point far above "
            "or below? Give finite z bounds in point_cloud_range, or larger pixel_sizes"
        )
    low = size // 2
    high = size - 1 - low
    if reach:  # the longest search of all pairs of a target
        bound = np.zeros((num_targets, 1), np.int64)
        np.maximum.at(bound[:, 0], cluster, farthest)
        low, high = np.minimum(low, bound), np.minimum(high, bound)

    # Templates have the class of their target.
    rows, width = (size + low).T
    lines = _LINES_CPU if device.type == "cpu" else _LINES_GPU
    is_line = rows * width <= lines[-1]
    height = np.where(is_line, 1, _at_least(FAST_LENGTHS, rows))
    length = np.where(is_line, _at_least(lines, rows * width), _at_least(FAST_LENGTHS, width))
    stride = np.where(is_line, width, length)
    keys, class_of_target = np.unique(height * _BASE + length, return_inverse=True)
    of_image = np.concatenate((cluster, np.arange(num_targets)))
    kind = 2 * class_of_target[of_image]  # class and role: even numbers are templates, odd ones targets
    kind[num_pairs:] += 1
    searched, max_energy = np.zeros((2, len(keys)), np.int64)
    np.maximum.at(searched, class_of_target, ((low + high) * np.stack((stride, np.ones_like(stride)), 1)).sum(1) + 1)
    np.maximum.at(max_energy, kind // 2, energies)
    images = np.bincount(kind, minlength=2 * len(keys)).reshape(-1, 2)
    classes = [
        SizeClass(*row) for row in np.column_stack((images, *divmod(keys, _BASE), searched, max_energy)).tolist()
    ]
    total = sum((shape.templates + shape.targets) * shape.area for shape in classes)
    require_memory(
        total + _BYTES_PER_SAMPLE * max(shape.area for shape in classes),
        device,
        f"a cluster that is {size.max()} pixels long",
        "give a max_speed, so that it is searched less far, a smaller point_cloud_range or larger pixel_sizes",
    )

    # The first sample of each image, and the index of each target in its class.
    order = np.argsort(kind, kind="stable")
    area, start = (height * length)[of_image[order]], np.empty_like(order)
    start[order] = area.cumsum() - area
    start[num_pairs:] += low[:, 0] * stride + low[:, 1]
    packed, packed_targets = order[order < num_pairs], order[order >= num_pairs] - num_pairs
    rank, first = np.empty(num_targets, np.int64), images[:, 1].cumsum() - images[:, 1]
    rank[packed_targets] = np.arange(num_targets) - first[class_of_target[packed_targets]]

    # One copy to the device holds the start and stride of each image and the columns of each packed pair.
    clusters = cluster[packed]
    of_target = *low.T, *high.T, stride, searched[class_of_target], rank
    table = np.stack((*(values[clusters] for values in of_target), packed, clusters))
    uploaded = torch.from_numpy(np.concatenate((start, stride[of_image], table.ravel()))).to(device)
    start_of_pixel, stride_of_pixel = take_columns(uploaded[: 2 * len(start)].view(2, -1), image)
    of_pair = uploaded[2 * len(start) :].view(len(table), -1)
    sample = torch.cat((template.row, target.row)).mul_(stride_of_pixel).add_(start_of_pixel)
    sample += torch.cat((template.col, target.col))
    samples = torch.zeros(total, dtype=torch.bool, device=device).index_fill_(0, sample, True)
    search = Search(of_pair[:2], of_pair[2:4], of_pair[4], of_pair[5])
    return Packing(samples, classes, of_pair[6], rank[clusters], search, of_pair[7], of_pair[8], energy, size)


def _at_least(lengths: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Round each value up to one of the ascending lengths; larger values get the last one."""
    table = np.asarray(lengths)
    return table[np.searchsorted(table, values).clip(max=len(table) - 1)]
