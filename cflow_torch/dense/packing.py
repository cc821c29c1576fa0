"""Clusters as small binary images in one buffer, laid out so that one correlation per size class finds all shifts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.bits import popcount
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
class Images:
    """A set of small binary images, given by their set pixels.

    Args:
        image: (P,) int64, image of each pixel.
        row, col: (P,) int64, place inside the image, from 0.
        slices: (P,) uint8, bit by bit the height slices in which the pixel is set, at least one; None = there is one
            slice, and it is.
    """

    image: Tensor
    row: Tensor
    col: Tensor
    slices: Optional[Tensor] = None

    def take(self, wanted: Tensor) -> Images:
        """Some of N images, numbered anew from 0. Args: wanted: (N,) bool."""
        pixel = flat_nonzero(wanted.index_select(0, self.image))
        image = (wanted.cumsum(0) - 1).index_select(0, self.image.index_select(0, pixel))
        row, col = self.row.index_select(0, pixel), self.col.index_select(0, pixel)
        return Images(image, row, col, None if self.slices is None else self.slices.index_select(0, pixel))

    def energy(self, num_images: int) -> Tensor:
        """(N,) int64, set pixels of each image, counted in every slice."""
        if self.slices is None:
            return torch.bincount(self.image, minlength=num_images)
        energy = torch.zeros(num_images, dtype=torch.int64, device=self.image.device)
        return energy.index_add_(0, self.image, popcount(self.slices))


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
class Drawing:
    """Templates and targets drawn in the shape of their class, class after class, templates before targets.

    Args:
        samples: (A,) bool, or uint8, bit by bit the slices.
        classes: of each class (templates, targets, Y, X, number of leading samples in which shifts are searched).
        jobs: (J,) int64, templates in the order in which they are drawn.
        targets: (N,) int64, targets in the order in which they are drawn.
    """

    samples: Tensor
    classes: List[Tuple[int, ...]]
    jobs: Tensor
    targets: Tensor


def search_bounds(size: Tensor, target_of_job: Tensor, radius: Optional[Tensor]) -> Tuple[Tensor, Tensor]:
    """(N, 2) farthest shifts down and up that any job of a target searches."""
    low = size // 2
    high = size - 1 - low
    if radius is not None:
        reach = low.new_zeros(len(size)).scatter_reduce_(
            0, target_of_job, radius.clamp(max=LONGEST_SIDE).floor().long(), "amax"
        )[:, None]
        low, high = torch.minimum(low, reach), torch.minimum(high, reach)
    return low, high


def draw(
    template: Images,
    target: Images,
    target_of_job: Tensor,
    size: Tensor,
    low: Tensor,
    high: Tensor,
    num_slices: int = 1,
) -> Tuple[Search, Drawing]:
    """Draw all templates and targets in one go; also what is searched for each target.

    Args:
        template, target, target_of_job, size, num_slices: as for `best_shifts`.
        low, high: as `search_bounds` gives them.

    Raises:
        CFlowError: a cluster that is too long, or takes more memory than there is.

    An image takes H + low_y rows of W + low_x samples, and a target is drawn low_y rows and low_x columns further down.
    Then shift (dy, dx) of the correlation stands at sample (dy + low_y) * stride + dx + low_x, and no other pair of
    pixels adds to the samples that are searched: neither across the end of a row nor across that of the image.
    """
    rows, width = (size + low).t().contiguous()
    lines = torch.tensor(_LINES, device=size.device)
    line = torch.searchsorted(lines, rows * width)
    is_line = line < len(_LINES)
    fast, last_fast = torch.tensor(FAST_LENGTHS, device=size.device), len(FAST_LENGTHS) - 1
    height = torch.where(is_line, 1, fast.take(torch.searchsorted(fast, rows).clamp(max=last_fast)))
    in_line = lines.take(line.clamp(max=len(_LINES) - 1))
    length = torch.where(is_line, in_line, fast.take(torch.searchsorted(fast, width).clamp(max=last_fast)))
    stride = torch.where(is_line, width, length)

    keys, class_of_target = torch.unique(height * _BASE + length, return_inverse=True)
    num_jobs, num_classes = target_of_job.numel(), keys.numel()
    kind = torch.cat((2 * class_of_target.index_select(0, target_of_job), 2 * class_of_target + 1))
    last = (low + high)[:, 0] * stride + (low + high)[:, 1]
    searched = torch.zeros_like(keys).scatter_reduce_(0, class_of_target, last + 1, "amax")
    images = torch.bincount(kind, minlength=2 * num_classes)
    *listed, longest = torch.cat((keys, searched, images, size.max()[None])).tolist()
    _check_length(longest)
    numbers = listed[2 * num_classes :]
    classes = [
        (*numbers[2 * c : 2 * c + 2], *divmod(listed[c], _BASE), listed[num_classes + c]) for c in range(num_classes)
    ]

    order = torch.sort(kind, stable=True).indices
    of_image = torch.cat((target_of_job, torch.arange(len(size), device=size.device)))
    area = (height * length).index_select(0, of_image.index_select(0, order))
    start = torch.empty_like(area).scatter_(0, order, area.cumsum(0) - area)
    start[num_jobs:] += low[:, 0] * stride + low[:, 1]
    image = torch.cat((template.image, target.image + num_jobs))
    row, col = torch.cat((template.row, target.row)), torch.cat((template.col, target.col))
    pixel = row.mul_(stride.index_select(0, of_image).index_select(0, image)).add_(col)
    pixel += start.index_select(0, image)
    total = sum((templates + targets) * y * x for templates, targets, y, x, _ in classes)
    largest = max(y * x for _, _, y, x, _ in classes)
    require_memory(
        total + _BYTES_PER_SAMPLE * num_slices * largest,
        size.device,
        f"a cluster that is {longest} pixels long",
        "give a max_speed, so that it is searched less far, a smaller point_cloud_range or larger pixel_sizes",
    )
    if template.slices is None or target.slices is None:
        samples = torch.zeros(total, dtype=torch.bool, device=pixel.device).index_fill_(0, pixel, True)
    else:
        samples = torch.zeros(total, dtype=torch.uint8, device=pixel.device)
        samples.scatter_(0, pixel, torch.cat((template.slices, target.slices)))
    is_job = order < num_jobs
    drawing = Drawing(
        samples,
        classes,
        order.index_select(0, flat_nonzero(is_job)),
        order.index_select(0, flat_nonzero(~is_job)) - num_jobs,
    )
    return Search(low, high, stride), drawing


def _check_length(longest: int) -> None:
    if longest > LONGEST_SIDE:
        raise CFlowError(
            f"a cluster is {longest} pixels long in one view (at most {LONGEST_SIDE}): is there a point far above or "
            "below? Give finite z bounds in point_cloud_range, or larger pixel_sizes"
        )
