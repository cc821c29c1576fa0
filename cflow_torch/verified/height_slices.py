"""Height-sliced occupancy: images of all sweeps at the finest pixels, with four height slices per pixel.

Slices keep a wheel from matching a roof. A slice is half a metre high, and the slices repeat every two metres. One
byte of an image holds the slices of its pixel and those of the 3 x 3 pixels around it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import (
    constant,
    flat_nonzero,
    floor_divide,
    lazy_zeros,
    occupied,
    split_index,
    take_columns,
)
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

NUM_SLICES = 4
SLICE_HEIGHT = 0.5  # metres
OWN = (1 << NUM_SLICES) - 1  # bits of the slices of the pixel itself
_COUNTS = tuple(bin(byte & OWN).count("1") + (bin(byte >> NUM_SLICES).count("1") << 32) for byte in range(256))
REACH = 2  # rows and columns; several steps search this far around a pixel


@dataclass(frozen=True)
class Pixels:
    """Occupied pixels of sweeps. Step 0 is sweep t+1, 1 is t, 2 is t-1, ..."""

    table: Tensor  # (5, K) int64: flat index into the images, window, step, row and column of each pixel
    slices: Tensor  # (K,) uint8, height slices of each pixel, a bit each

    @classmethod
    def of(cls, index: Tensor, slices: Tensor, grid: Grid, num_steps: int) -> Pixels:
        """Make pixels from their flat indices, (K,) int64, and their slices, (K,) uint8."""
        of_image, within = split_index(index, grid.height * grid.width)
        columns = (index, *split_index(of_image, num_steps), *split_index(within, grid.width))
        return cls(torch.stack(columns), slices)

    @property
    def index(self) -> Tensor:
        """(K,) int64."""
        return self.table[0]

    @property
    def window(self) -> Tensor:
        """(K,) int64."""
        return self.table[1]

    @property
    def step(self) -> Tensor:
        """(K,) int64."""
        return self.table[2]

    @property
    def row_col(self) -> Tensor:
        """(2, K) int64."""
        return self.table[3:]

    def take(self, index: Tensor) -> Pixels:
        """Select pixels by (L,) int64 positions in the list."""
        return Pixels(take_columns(self.table, index), self.slices.index_select(0, index))


@dataclass(frozen=True)
class HeightSlicedSweeps:
    """All sweeps of all windows, as height-sliced images."""

    batch: Batch  # the points
    grid: Grid  # the finest BEV
    # (I,) uint8 with I - 1 = 2 B S H W. Bits 0 ... 3: the pixel has a point in this height slice. Bits 4 ... 7: one of
    # the 3 x 3 pixels around has one. The second half is empty until `with_copies` draws there. The last entry, always
    # 0, is for positions outside the images.
    image: Tensor
    rank: Tensor  # (I,) int32, 1 + position of each occupied pixel in the list `pixels`; 0 for empty pixels
    pixels: Pixels  # the list of the P occupied pixels, in order of their index
    # (N + K,) int64, for each point, then for each copy: position of its pixel in the list; P for points that are
    # inactive or in a pixel that was left out.
    pixel_of_point: Tensor
    copied: Tensor  # (K,) int64, the points that have copies; empty before `with_copies`

    @classmethod
    def of(cls, batch: Batch, grid: Grid, min_height: float | None = None) -> HeightSlicedSweeps:
        """Draw every sweep of a batch with its height slices.

        Args:
            batch: its positions have three axes.
            min_height: metres; we leave out pixels whose points are all lower than this above the ground, unless a
                higher pixel is near. None = all are drawn.

        Convention:
            The slice of a height z is floor(z / 0.5 m) mod 4 in float64. A height is compared with the ground in
            centimetres. "Near": at most two rows and two columns away.

        Cost: linear in points and pixels.
        """
        device, num_images = batch.image.device, batch.num_windows * batch.num_steps
        num_points, num_indices = batch.image.numel(), num_images * grid.height * grid.width
        image = lazy_zeros(2 * num_indices + 1, torch.uint8, device)
        index = torch.empty(num_points, dtype=torch.int64, device=device)
        height_slice, is_low = (torch.empty(num_points, dtype=of, device=device) for of in (torch.uint8, torch.bool))
        ground = None if min_height is None or batch.ground is None else batch.ground.mean()
        for points in chunks(0, num_points, device):
            positions = batch.positions[:, points]
            at = grid.pixel_of_image(positions, batch.image[points], num_images, batch.is_active[points]).long()
            image.index_fill_(0, at, 1)
            index[points] = at
            height_slice[points] = slice_of(positions[2], SLICE_HEIGHT)
            if ground is not None and batch.ground is not None and min_height is not None:
                window = floor_divide(batch.image[points].long(), batch.num_steps)
                height = batch.ground.at(positions, window, ground)
                is_low[points] = positions[2] * 100 < height + round(100 * min_height)
        if ground is not None:  # after all points are drawn, because one tall point makes its pixel tall
            image.index_fill_(0, index.masked_fill(is_low, num_indices), 2)
        image[num_indices].zero_()  # inactive points were drawn here
        pixel = occupied(image[:num_indices])
        rank = lazy_zeros(len(image), torch.int32, device)
        if ground is not None:
            is_kept = _is_near_tall(image, pixel, grid)
            image.index_copy_(0, pixel, is_kept.byte())
            pixel = pixel.index_select(0, flat_nonzero(is_kept))
        rank.scatter_(0, pixel, torch.arange(1, len(pixel) + 1, dtype=torch.int32, device=device))
        pixel_of_point = (rank.index_select(0, index).long() - 1).remainder_(len(pixel) + 1)
        slices = _slices(pixel_of_point, height_slice, len(pixel))
        pixels = Pixels.of(pixel, slices, grid, batch.num_steps)
        _draw_neighbourhoods(image, pixels, grid)
        return cls(batch, grid, image, rank, pixels, pixel_of_point, pixel[:0])

    def with_copies(self, rows: Tensor) -> HeightSlicedSweeps:
        """Return the sweeps with copies of some points, drawn by themselves in further windows B ... 2 B - 1.

        Copies follow the points, and their pixels follow the other pixels. The result shares its images with `self`,
        and they hold one set of copies, so call this method only once.

        Args:
            rows: (K,) int64, points of the batch.
        """
        count = self.num_pixels
        height_slice = slice_of(self.batch.positions[2].index_select(0, rows), SLICE_HEIGHT)
        pixel, of_copy = torch.unique(self.pixel_of_point.index_select(0, rows), return_inverse=True)
        # The same pixels, in the second half of the images and of the windows.
        behind = constant((self.image.numel() // 2, self.batch.num_windows, 0, 0, 0), torch.int64, rows.device)
        table = take_columns(self.pixels.table, pixel).add_(behind[:, None])
        pixels = Pixels(table, _slices(of_copy, height_slice, len(pixel)))
        _draw_neighbourhoods(self.image, pixels, self.grid)
        rank = torch.arange(count + 1, count + 1 + len(pixel), dtype=torch.int32, device=rows.device)
        none = self.pixel_of_point == count
        of_point = self.pixel_of_point.masked_fill(none, count + len(pixel))  # "none" is now a larger number
        return replace(
            self,
            batch=self.batch.with_empty_windows(),
            rank=self.rank.scatter_(0, pixels.index, rank),
            pixels=Pixels(torch.cat((self.pixels.table, table), 1), torch.cat((self.pixels.slices, pixels.slices))),
            pixel_of_point=torch.cat((of_point, of_copy + count)),
            copied=rows,
        )

    @property
    def num_pixels(self) -> int:
        """P, the number of occupied pixels."""
        return len(self.pixels.index)

    @property
    def num_steps(self) -> int:
        """S."""
        return self.batch.num_steps

    @property
    def elapsed(self) -> Tensor:
        """(B, S) float64, sweep intervals from each sweep to t+1."""
        return self.batch.elapsed

    @cached_property
    def intervals(self) -> Tensor:
        """(B, 2 S - 1) float64, sweep intervals from t+1 to step S - 1 ... 1, 0, then from step 1 ... S - 1 to t+1."""
        return torch.cat((-self.elapsed.flip(1), self.elapsed[:, 1:]), 1)

    @cached_property
    def elapsed_of_pixel(self) -> Tensor:
        """(P,) float64, sweep intervals from the sweep of each occupied pixel to t+1."""
        sweep = torch.add(self.pixels.step, self.pixels.window, alpha=self.num_steps)
        return self.elapsed.flatten().index_select(0, sweep)

    @cached_property
    def num_more(self) -> Tensor:
        """(B,) int64, number of sweeps of each window besides t and t+1."""
        return (self.batch.elapsed != 0).sum(1) - 1

    @cached_property
    def has_history(self) -> Tensor:
        """(B,) bool, True = the window has more sweeps than t and t+1."""
        return self.num_more > 0

    def or_outside(self, index: Tensor, at: Tensor) -> Tensor:
        """Set the index of each pixel outside the images to the last entry of `image`. Return (...) int64.

        Args:
            index: (...) int64, flat indices into `image`; the indices of pixels outside may be wrong.
            at: (2, ...) int64, rows and columns of the same pixels, any value.
        """
        is_above_or_below, is_beside = _is_outside(at, self.grid)
        return index.masked_fill(is_above_or_below | is_beside, self.image.numel() - 1)

    def around(self, pixel: Tensor, reach: int) -> Tensor:
        """Return the occupied pixels of the same sweep around each of K pixels, up to `reach` pixels each way.

        `pixel`, (K,) int64, and the result, (K, (2 reach + 1)^2) int64 in raster order, are positions in the list. The
        result is P where a pixel is empty or outside the image.
        """
        line, table = range(-reach, reach + 1), take_columns(self.pixels.table, pixel)[..., None]
        shifts = tuple(zip(*((down, right) for down in line for right in line)))
        shift = constant(shifts, torch.int64, pixel.device)
        index = table[0] + torch.add(shift[1], shift[0], alpha=self.grid.width)
        index = self.or_outside(index, table[3:] + shift[:, None])
        rank = self.rank.index_select(0, index.view(-1)).view_as(index).long()
        return (rank - 1).remainder_(self.num_pixels + 1)

    @cached_property
    def row_of_point(self) -> Tensor:
        """(N + K,) int64, batch row of each point, then of each copied point."""
        return torch.cat((torch.arange(self.batch.image.numel(), device=self.copied.device), self.copied))


def slice_of(z: Tensor, slice_height: float, num_slices: int = NUM_SLICES) -> Tensor:
    """Return the slices of heights, (N,) float64, metres: floor(z / slice_height) mod n, (N,) uint8; 0 for NaN. n is a
    power of 2, at most 16."""
    layer = (z / constant((slice_height,), z.dtype, z.device)).floor_()  # see `Grid.pixel`
    layer.clamp_(-(2.0**56), 2.0**56).nan_to_num_(0.0)  # larger float64 are multiples of 16: slice 0 as well
    return (layer.long() & (num_slices - 1)).to(torch.uint8)


def count_slices(slices: Tensor) -> Tensor:
    """Count the set bits in both halves of uint8 values: int64, the count of the lower four bits, plus 2^32 times the
    count of the upper four. So one sum adds up both counts."""
    return constant(_COUNTS, torch.int64, slices.device).index_select(0, slices.reshape(-1).int()).view(slices.shape)


def _slices(of_point: Tensor, height_slice: Tensor, num_pixels: int) -> Tensor:
    """Return the bit mask of the slices in each pixel, (P,) uint8, from the pixel of each point, (N,) int64, P = none,
    and its slice, (N,) uint8."""
    lanes = torch.zeros((num_pixels + 1) * NUM_SLICES, dtype=torch.bool, device=height_slice.device)
    lanes.index_fill_(0, torch.add(height_slice, of_point, alpha=NUM_SLICES), True)
    # A pixel is four bytes that are 0 or 1. Read as one number, these are its bits 0, 8, 16 and 24.
    # The product moves them to bits 24 ... 27. Other terms lie lower or overflow, and no two terms share a bit.
    word = lanes.view(torch.int32)[:num_pixels] * 0x01020408
    return (word >> 24).bitwise_and_(OWN).to(torch.uint8)


def _draw_neighbourhoods(image: Tensor, pixels: Pixels, grid: Grid) -> None:
    """Write the slices of each pixel into its own entry, and into the upper bits of the 3 x 3 entries around it."""
    above, outside = pixels.slices << NUM_SLICES, image.numel() - 1
    image.index_copy_(0, pixels.index, pixels.slices | above)
    line = constant((-1, 0, 1), torch.int64, image.device)
    around = pixels.index + torch.add(line, line[:, None], alpha=grid.width)[..., None]
    is_above_or_below, is_beside = _is_outside(pixels.row_col[:, None] + line[:, None], grid)
    around.masked_fill_(is_above_or_below[:, None] | is_beside, outside)
    # Within a round, all indices differ, except those outside, where the value does not matter.
    upper, middle, lower = around.flatten(1)
    left, _, right = middle.view(3, -1)
    for index in (left, right):
        image.index_copy_(0, index, image.index_select(0, index).bitwise_or_(above))
    of_row = image.index_select(0, middle).bitwise_and_(OWN << NUM_SLICES)
    for index in (upper, lower):
        image.index_copy_(0, index, image.index_select(0, index).bitwise_or_(of_row))
    image[outside].zero_()


def _is_outside(at: Tensor, grid: Grid) -> Tensor:
    """Return whether rows and columns, (2, ...) int64, lie outside the images, (2, ...) bool."""
    last = constant((grid.height - 1, grid.width - 1), torch.int64, at.device)
    return (at < 0) | (at > last.view(2, *(1,) * (at.dim() - 1)))  # clamp by tensors is several times slower on the CPU


def _is_near_tall(image: Tensor, pixel: Tensor, grid: Grid) -> Tensor:
    """Return whether a tall pixel, of value 2, is at most `REACH` rows and columns away from each pixel, (P,) bool.
    Low pixels are often ground that the mask misses. Such ground seems to move, as it differs in every sweep."""
    answer = image.index_select(0, pixel) == 2
    low = flat_nonzero(~answer)
    line, col = split_index(pixel.index_select(0, low), grid.width)
    number, row = split_index(line, grid.height)
    reach = constant(tuple(range(-REACH, REACH + 1)), torch.int64, pixel.device)
    # Beyond the border, we look up the pixel at the border, which is within reach as well.
    rows = (row[:, None] + reach).clamp_(0, grid.height - 1).add_(number[:, None], alpha=grid.height)
    cols = (col[:, None] + reach).clamp_(0, grid.width - 1)
    index = torch.add(cols[:, None], rows[:, :, None], alpha=grid.width)
    is_tall = image.index_select(0, index.view(-1)).view(len(low), len(reach) ** 2) == 2
    return answer.index_copy_(0, low, is_tall.any(1))
