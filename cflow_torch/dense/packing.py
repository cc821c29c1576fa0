"""Templates and targets packed into one buffer, laid out so that one correlation per size class finds all shifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.dense.templates import TemplatePairs
from cflow_torch.ops.cross_correlation import FAST_LENGTHS
from cflow_torch.ops.indices import take_columns
from cflow_torch.types import CFlowError, as_numpy
from cflow_torch.windows.bev_grid import LONGEST_SIDE
from cflow_torch.windows.memory import require_memory

# Images that fit are laid out as one line of this many samples, whatever their height and width: most clusters are
# small, and few classes mean few kernel launches. Larger images are rare; on a CPU they keep two dimensions, whose
# transforms cost less than those of a line, and have classes of their own by height and width. On a GPU a batch of many
# windows is to have no more classes than one window.
_LINES_CPU = tuple(144 << k for k in range(8))  # square clusters of 8, 11, 16, ... 90 pixels
_LINES_GPU = tuple(144 << 2 * k for k in range(9))
# Spectra, counts and tables of an image that is correlated alone, the largest one.
_BYTES_PER_SAMPLE = 80
# Classes are numbered by height and width of their images, both below this.
_BASE = 1 << 24


@dataclass(frozen=True)
class Search:
    """Shifts that are searched for each of K images: dy in [-low_y, high_y], dx in [-low_x, high_x].

    Args:
        low, high: (2, K) int64, (y, x).
        stride: (K,) int64, samples from one row of the image to the next, and from one dy to the next.
        searched: (K,) int64, leading samples in which shifts are searched, as many for all images of a class.
    """

    low: Tensor
    high: Tensor
    stride: Tensor
    searched: Tensor

    def shift(self, sample: Tensor) -> Tensor:
        """(2, K) int64, dy and dx that stand at a sample of each image, (K,) int64; beyond `high` it means nothing."""
        row = sample // self.stride
        return torch.stack((row, sample - row * self.stride)) - self.low


class SizeClass(NamedTuple):
    """Images of one shape: how many templates and targets, Y and X, leading samples in which shifts are searched,
    pixels of the image that has most.
    """

    templates: int
    targets: int
    height: int
    width: int
    searched: int
    most: int

    @property
    def area(self) -> int:
        """Samples of an image."""
        return self.height * self.width


@dataclass(frozen=True)
class Packing:
    """Templates and targets in the shape of their class, class after class, templates before targets.

    Args:
        samples: (A,) bool.
        classes: of the images.
        own: (J,) int64, target of each packed pair, counted through the targets of its class.
        own_on_host: the same.
        search: what is searched for each packed pair.
        pairs: (J,) int64, pairs in the order in which their templates are packed.
        clusters: (J,) int64, target of each of them in the order in which targets were given.
        energy: (J + N,) int64, set pixels of all templates and targets, in the order in which they were given.
        size: (N, 2) int64, on the host: height and width of all targets.
    """

    samples: Tensor
    classes: list[SizeClass]
    own: Tensor
    own_on_host: np.ndarray
    search: Search
    pairs: Tensor
    clusters: Tensor
    energy: Tensor
    size: np.ndarray


def pack(pairs: TemplatePairs) -> Packing:
    """Pack all templates and targets in one go.

    Args:
        pairs: at least one.

    Raises:
        CFlowError: a cluster that is too long, or takes more memory than there is.

    An image takes H + low_y rows of W + low_x samples, and a target stands low_y rows and low_x columns further down.
    Then shift (dy, dx) of the correlation stands at sample (dy + low_y) * stride + dx + low_x, and no other pair of
    pixels adds to the samples that are searched: neither across the end of a row nor across that of the image.
    """
    device, num_pairs, num_targets = pairs.size.device, len(pairs.cluster), len(pairs.size)
    template, target = pairs.template, pairs.target
    image = torch.cat((template.image, target.image + num_pairs))
    energy = torch.zeros(num_pairs + num_targets, dtype=torch.int64, device=device)
    energy.index_add_(0, image, torch.ones_like(image))
    reach = () if pairs.radius is None else (pairs.radius.clamp(max=LONGEST_SIDE).floor().long(),)
    numbers = as_numpy(torch.cat((pairs.size.flatten(), pairs.cluster, energy, *reach)))
    size, numbers = numbers[: 2 * num_targets].reshape(-1, 2), numbers[2 * num_targets :]
    cluster, energies, farthest = np.split(numbers, np.cumsum((num_pairs, num_pairs + num_targets)))
    _check_length(size.max())
    low = size // 2
    high = size - 1 - low
    if reach:  # the farthest that any pair of a target searches
        bound = np.zeros((num_targets, 1), np.int64)
        np.maximum.at(bound[:, 0], cluster, farthest)
        low, high = np.minimum(low, bound), np.minimum(high, bound)

    rows, width = (size + low).T
    lines = _LINES_CPU if device.type == "cpu" else _LINES_GPU
    is_line = rows * width <= lines[-1]
    height = np.where(is_line, 1, _at_least(FAST_LENGTHS, rows))
    length = np.where(is_line, _at_least(lines, rows * width), _at_least(FAST_LENGTHS, width))
    stride = np.where(is_line, width, length)
    keys, class_of_target = np.unique(height * _BASE + length, return_inverse=True)
    of_image = np.concatenate((cluster, np.arange(num_targets)))
    kind = 2 * class_of_target[of_image]
    kind[num_pairs:] += 1
    searched, most = np.zeros((2, len(keys)), np.int64)
    np.maximum.at(searched, class_of_target, ((low + high) * np.stack((stride, np.ones_like(stride)), 1)).sum(1) + 1)
    np.maximum.at(most, kind // 2, energies)
    images = np.bincount(kind, minlength=2 * len(keys)).reshape(-1, 2)
    classes = [SizeClass(*row) for row in np.column_stack((images, *divmod(keys, _BASE), searched, most)).tolist()]
    total = sum((found.templates + found.targets) * found.area for found in classes)
    require_memory(
        total + _BYTES_PER_SAMPLE * max(found.area for found in classes),
        device,
        f"a cluster that is {size.max()} pixels long",
        "give a max_speed, so that it is searched less far, a smaller point_cloud_range or larger pixel_sizes",
    )

    order = np.argsort(kind, kind="stable")
    area, start = (height * length)[of_image[order]], np.empty_like(order)
    start[order] = area.cumsum() - area
    start[num_pairs:] += low[:, 0] * stride + low[:, 1]
    packed, packed_targets = order[order < num_pairs], order[order >= num_pairs] - num_pairs
    place, first = np.empty(num_targets, np.int64), images[:, 1].cumsum() - images[:, 1]
    place[packed_targets] = np.arange(num_targets) - first[class_of_target[packed_targets]]
    clusters = cluster[packed]
    of_search = *low.T, *high.T, stride, searched[class_of_target], place
    table = np.stack((*(values[clusters] for values in of_search), packed, clusters))
    uploaded = torch.from_numpy(np.concatenate((start, stride[of_image], table.ravel()))).to(device)
    of_pixel = take_columns(uploaded[: 2 * len(start)].view(2, -1), image)
    of_pair = uploaded[2 * len(start) :].view(len(table), -1)
    sample = torch.cat((template.row, target.row)).mul_(of_pixel[1]).add_(of_pixel[0])
    sample += torch.cat((template.col, target.col))
    samples = torch.zeros(total, dtype=torch.bool, device=device).index_fill_(0, sample, True)
    search = Search(of_pair[:2], of_pair[2:4], of_pair[4], of_pair[5])
    *_, own, first, second = of_pair
    return Packing(samples, classes, own, place[clusters], search, first, second, energy, size)


def _at_least(lengths: Sequence[int], values: np.ndarray) -> np.ndarray:
    """The smallest of some ascending lengths that is not below each value; the last one if there is none."""
    table = np.asarray(lengths)
    return table[np.searchsorted(table, values).clip(max=len(table) - 1)]


def _check_length(longest: int) -> None:
    if longest > LONGEST_SIDE:
        raise CFlowError(
            f"a cluster is {longest} pixels long in one view (at most {LONGEST_SIDE}): is there a point far above or "
            "below? Give finite z bounds in point_cloud_range, or larger pixel_sizes"
        )
