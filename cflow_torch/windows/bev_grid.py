"""The bird's-eye-view grid: map points to pixels and draw occupancy images (Eq. 3d_to_bev, bev_dims)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.ops.indices import constant
from cflow_torch.types import CFlowError

# int64 indices allow more pixels, but images of this size already take minutes.
_MOST_PIXELS = 2**30
# The correlation packs a shift into one number to break ties; shifts of longer images would not fit.
LONGEST_SIDE = 2**15


@dataclass(frozen=True)
class Grid:
    """A BEV grid of square pixels; row from y, column from x."""

    pixel_size: float  # s, metres
    lower: tuple[float, ...]  # (x0, y0, z0), p^-, metres, lower end of the region, frame of t+1
    upper: tuple[float, ...]  # (x1, y1, z1), p^+, upper end; both ends belong to the region

    def __post_init__(self) -> None:
        # Not `height` and `width`: their floor raises if a side is infinite.
        rows, cols = ((self.upper[axis] - self.lower[axis]) / self.pixel_size + 1 for axis in (1, 0))
        if not (max(rows, cols) < LONGEST_SIDE + 1 and self.height * self.width <= _MOST_PIXELS):
            raise CFlowError(
                f"a region of {cols:.9g} x {rows:.9g} pixels of {self.pixel_size} m is too large "
                f"(at most {LONGEST_SIDE} a side and {_MOST_PIXELS} in all): "
                "give a smaller point_cloud_range or larger pixel_sizes"
            )

    @property
    def height(self) -> int:
        """H of Eq. bev_dims."""
        return math.floor((self.upper[1] - self.lower[1]) / self.pixel_size) + 1

    @property
    def width(self) -> int:
        """W of Eq. bev_dims."""
        return math.floor((self.upper[0] - self.lower[0]) / self.pixel_size) + 1

    def centre(self, pixel: Tensor) -> Tensor:
        """Return y and x of the centres of pixels, (2, K) float64, metres; `pixel` is (2, K), rows and columns."""
        lower = constant(self.lower[1::-1], torch.float64, pixel.device)
        return pixel.double().add_(0.5).mul_(self.pixel_size).add_(lower[:, None])

    def contains(self, positions: Tensor) -> Tensor:
        """Test whether positions, (2, N) or (3, N) float64, metres, are finite and in the region, ends included."""
        # A value is inside if clamping keeps it; NaN and infinity fail. eq_ writes ones and zeros in place: on the CPU
        # two comparisons that write bools take almost twice as long.
        largest = torch.finfo(positions.dtype).max
        inside, *others = (
            values.clamp(max(lower, -largest), min(upper, largest)).eq_(values)
            for values, lower, upper in zip(positions.unbind(0), self.lower, self.upper)
        )
        for other in others:
            inside.mul_(other)
        return inside.bool()

    def pixel(self, positions: Tensor) -> Tensor:
        """Return the raster index, row * W + col, of each position (Eq. 3d_to_bev).

        Rows and columns are floor((p - p_lower) / s) with a true division in float64. The divisor is a tensor, because
        a GPU multiplies by the reciprocal of a plain number, which rounds differently.

        Args:
            positions: (2, N) or (3, N) float64, metres.

        Returns:
            (N,) int32; undefined outside the region.
        """
        size = constant((self.pixel_size,), positions.dtype, positions.device)
        # Inside the region nothing is below the lower end, so int() rounds down.
        lower = constant(self.lower[:2], positions.dtype, positions.device)
        col, row = (positions[:2] - lower[:, None]).div_(size).int()
        return col.add_(row, alpha=self.width)

    def pixel_of_image(
        self, positions: Tensor, image: Tensor, num_images: int, is_active: Tensor | None = None
    ) -> Tensor:
        """Return the flat index of each point's pixel in a stack of B images, (N,) int32 (int64 if that is too small).

        `positions` are (2, N) or (3, N) float64, metres, frame of t+1. `image` is the image of each point, (N,) int32
        or int64. Points that are not active get the index B * H * W. `is_active`, (N,) bool, must be False outside the
        region; None = all points are active and inside.
        """
        num_pixels = num_images * self.height * self.width
        pixel = self.pixel(positions)
        if num_pixels > torch.iinfo(torch.int32).max:
            pixel = pixel.long()
        pixel.add_(image, alpha=self.height * self.width)
        if is_active is not None:  # masked_fill_ would take four times as long as this product
            pixel.sub_(num_pixels).mul_(is_active.to(pixel.dtype)).add_(num_pixels)
        return pixel

    def draw(self, pixel: Tensor, num_images: int) -> Tensor:
        """Return (B, H, W) bool images that are True at the (N,) int64 pixels from `pixel_of_image`."""
        num_pixels = num_images * self.height * self.width
        occupancy = torch.zeros(num_pixels + 1, dtype=torch.bool, device=pixel.device).index_fill_(0, pixel, True)
        return occupancy[:-1].view(num_images, self.height, self.width)
