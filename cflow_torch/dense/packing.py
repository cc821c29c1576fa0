"""Templates and targets packed into one buffer, laid out so that one correlation per size class finds all shifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Tuple

import torch
from torch import Tensor

from cflow_torch.dense.templates import TemplatePairs
from cflow_torch.ops.cross_correlation import FAST_LENGTHS
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.types import CFlowError
from cflow_torch.windows.bev_grid import LONGEST_SIDE
from cflow_torch.windows.memory import require_memory

# Images that fit are laid out as one line of this many samples, whatever their height and width: most clusters are
# small, and few classes mean few kernel launches. Larger images are rare; they keep two dimensions, whose transforms
# cost less than those of a line, and have classes of their own by height and width.
_LINES = (144, 576, 2304, 9216)  # square clusters of 8, 16, 32, 64 pixels
# Spectra, counts and tables of an image that is correlated alone, the largest one.
_BYTES_PER_SAMPLE = 80
# Classes are numbered by height and width of their images, both below this.
_BASE = 1 << 17


@dataclass(frozen=True)
class Search:
    """Shifts that are searched for each of K images: dy in [-low_y, high_y], dx in [-low_x, high_x].

    Args:
        low, high: (K, 2) int64, (y, x).
        stride: (K,) int64, samples from one row of the image to the next, and from one dy to the next.
    """

    low: Tensor
    high: Tensor
    stride: Tensor

    def take(self, index: Tensor) -> Search:
        """Those of some images."""
        return Search(*(values.index_select(0, index) for values in (self.low, self.high, self.stride)))

    def shift(self, sample: Tensor) -> Tuple[Tensor, Tensor]:
        """dy and dx that stand at a sample of each image, (K,) int64; beyond `high` it means nothing."""
        row = sample // self.stride
        return row - self.low[:, 0], sample - row * self.stride - self.low[:, 1]


@dataclass(frozen=True)
class Packing:
    """Templates and targets in the shape of their class, class after class, templates before targets.

    Args:
        samples: (A,) bool.
        classes: of each class (templates, targets, Y, X, number of leading samples in which shifts are searched).
        pairs: (J,) int64, pairs in the order in which their templates are packed.
        targets: (N,) int64, targets in the order in which they are packed.
    """

    samples: Tensor
    classes: List[Tuple[int, ...]]
    pairs: Tensor
    targets: Tensor


def pack(pairs: TemplatePairs) -> Tuple[Search, Packing]:
    """Pack all templates and targets in one go; also what is searched for each of N targets.

    Args:
        pairs: at least one.

    Raises:
        CFlowError: a cluster that is too long, or takes more memory than there is.

    An image takes H + low_y rows of W + low_x samples, and a target stands low_y rows and low_x columns further down.
    Then shift (dy, dx) of the correlation stands at sample (dy + low_y) * stride + dx + low_x, and no other pair of
    pixels adds to the samples that are searched: neither across the end of a row nor across that of the image.
    """
    size, of_pair, device = pairs.size, pairs.cluster, pairs.size.device
    low, high = _search_bounds(pairs)
    rows, width = (size + low).t().contiguous()
    lines = torch.tensor(_LINES, device=device)
    line = torch.searchsorted(lines, rows * width)
    is_line = line < len(_LINES)
    fast, last_fast = torch.tensor(FAST_LENGTHS, device=device), len(FAST_LENGTHS) - 1
    height = torch.where(is_line, 1, fast.take(torch.searchsorted(fast, rows).clamp(max=last_fast)))
    in_line = lines.take(line.clamp(max=len(_LINES) - 1))
    length = torch.where(is_line, in_line, fast.take(torch.searchsorted(fast, width).clamp(max=last_fast)))
    stride = torch.where(is_line, width, length)

    keys, class_of_target = torch.unique(height * _BASE + length, return_inverse=True)
    num_pairs, num_classes = of_pair.numel(), keys.numel()
    kind = torch.cat((2 * class_of_target.index_select(0, of_pair), 2 * class_of_target + 1))
    last = (low + high)[:, 0] * stride + (low + high)[:, 1]
    searched = torch.zeros_like(keys).scatter_reduce_(0, class_of_target, last + 1, "amax")
    images = torch.bincount(kind, minlength=2 * num_classes)
    *listed, longest = torch.cat((keys, searched, images, size.max()[None])).tolist()
    _check_length(longest)
    numbers = listed[2 * num_classes :]
    classes = [
        (*numbers[2 * c : 2 * c + 2], *divmod(listed[c], _BASE), listed[num_classes + c]) for c in range(num_classes)
    ]
    total = sum((templates + targets) * y * x for templates, targets, y, x, _ in classes)
    require_memory(
        total + _BYTES_PER_SAMPLE * max(y * x for _, _, y, x, _ in classes),
        device,
        f"a cluster that is {longest} pixels long",
        "give a max_speed, so that it is searched less far, a smaller point_cloud_range or larger pixel_sizes",
    )

    order = torch.sort(kind, stable=True).indices
    of_image = torch.cat((of_pair, torch.arange(len(size), device=device)))
    area = (height * length).index_select(0, of_image.index_select(0, order))
    start = torch.empty_like(area).scatter_(0, order, area.cumsum(0) - area)
    start[num_pairs:] += low[:, 0] * stride + low[:, 1]
    template, target = pairs.template, pairs.target
    image = torch.cat((template.image, target.image + num_pairs))
    row, col = torch.cat((template.row, target.row)), torch.cat((template.col, target.col))
    sample = row.mul_(stride.index_select(0, of_image).index_select(0, image)).add_(col)
    sample += start.index_select(0, image)
    samples = torch.zeros(total, dtype=torch.bool, device=device).index_fill_(0, sample, True)
    is_pair = order < num_pairs
    first, last = order.index_select(0, flat_nonzero(is_pair)), order.index_select(0, flat_nonzero(~is_pair))
    return Search(low, high, stride), Packing(samples, classes, first, last - num_pairs)


def _search_bounds(pairs: TemplatePairs) -> Tuple[Tensor, Tensor]:
    """(N, 2) farthest shifts down and up that any pair of a target searches."""
    low = pairs.size // 2
    high = pairs.size - 1 - low
    if pairs.radius is not None:
        reach = pairs.radius.clamp(max=LONGEST_SIDE).floor().long()
        reach = low.new_zeros(len(low)).scatter_reduce_(0, pairs.cluster, reach, "amax")[:, None]
        low, high = torch.minimum(low, reach), torch.minimum(high, reach)
    return low, high


def _check_length(longest: int) -> None:
    if longest > LONGEST_SIDE:
        raise CFlowError(
            f"a cluster is {longest} pixels long in one view (at most {LONGEST_SIDE}): is there a point far above or "
            "below? Give finite z bounds in point_cloud_range, or larger pixel_sizes"
        )
