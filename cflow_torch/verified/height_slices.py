"""Height-sliced occupancy: the finest images of all sweeps with four height slices a pixel, and what is occupied."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Optional, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import divide, flat_nonzero, occupied, split_index
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.ground_residue import TALL, clear_ground_residue, is_tall
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

# Height slices are told apart by this many numbers, then they repeat: 2 m of four slices of 0.5 m.
NUM_SLICES = 4
SLICE_HEIGHT = 0.5  # metres
# Beyond this float64 only holds multiples of 16, so cutting heights off here changes no slice.
_HIGHEST_SLICE = 2.0**56


@dataclass(frozen=True)
class HeightSlicedSweeps:
    """All sweeps of all windows as the verified method sees them: bits of height slices of P occupied pixels.

    Args:
        batch: the points.
        grid: the finest BEV.
        image: (B * S * H * W + 1,) uint8, bit c = a point of height slice c lies there; the last entry, always 0, is
            for whatever lies outside the images. Step 0 of S is sweep t+1, 1 = t, ...
        place: (N,) int64, flat index into `image` of every point; its last entry for those that take no part or lie on
            a pixel that is left out.
        pixel: (P,) int64, flat indices of the occupied pixels, ascending.
        window, step, row, col: (P,) int64, where each of them lies.
        slices: (P,) uint8, what `image` holds there.
    """

    batch: Batch
    grid: Grid
    image: Tensor
    place: Tensor
    pixel: Tensor
    window: Tensor
    step: Tensor
    row: Tensor
    col: Tensor
    slices: Tensor

    @classmethod
    def of(cls, batch: Batch, grid: Grid, min_height: Optional[float] = None) -> HeightSlicedSweeps:
        """Draw every sweep of a batch with its height slices.

        Args:
            batch: positions with three axes.
            grid: the finest BEV.
            min_height: metres; pixels that do not stand out of the ground of the batch by this much are left out, see
                `clear_ground_residue`. None = all are drawn.

        Convention:
            The slice of a height z is floor(z / 0.5 m) mod 4 in float64.

        Cost: linear in points and pixels.
        """
        num_images, num_points = batch.num_windows * batch.num_steps, batch.image.numel()
        image = torch.zeros(num_images * grid.height * grid.width + 1, dtype=torch.uint8, device=batch.image.device)
        place = torch.empty(num_points, dtype=torch.int64, device=image.device)
        ground = None if min_height is None or batch.ground is None else batch.ground.mean()
        for points in chunks(0, num_points, image.device):
            positions, takes_part = batch.positions[:, points], batch.takes_part[points]
            at = grid.pixel_of_image(positions, batch.image[points], num_images, takes_part).long()
            # Rows that take no part have any slice: what they draw is wiped off.
            part = slice_of(positions[2], SLICE_HEIGHT)
            for index in range(NUM_SLICES):
                set_bit(image, at.index_select(0, flat_nonzero(part == index)), 1 << index)
            if ground is not None and min_height is not None and batch.ground is not None:
                window = divide(batch.image[points].long(), batch.num_steps)
                height = batch.ground.below(positions, window, ground)
                high = flat_nonzero(is_tall(positions[2], height, min_height) & (at < image.numel() - 1))
                set_bit(image, at.index_select(0, high), TALL)
            place[points] = at
        image[-1:] = 0
        pixel = occupied(image)
        if ground is not None:
            pixel = clear_ground_residue(image, pixel, grid)
            place = torch.where(image.index_select(0, place) != 0, place, image.numel() - 1)
        of_image, within = split_index(pixel, grid.height * grid.width)
        window, step = split_index(of_image, batch.num_steps)
        row, col = split_index(within, grid.width)
        return cls(batch, grid, image, place, pixel, window, step, row, col, image.index_select(0, pixel))

    @property
    def num_windows(self) -> int:
        """B."""
        return self.batch.num_windows

    @property
    def num_steps(self) -> int:
        """S."""
        return self.batch.num_steps

    @property
    def elapsed(self) -> Tensor:
        """(B, S) float64, sweep intervals from each sweep to t+1."""
        return self.batch.elapsed

    def index(self, window: Tensor, step: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """Flat index into `image` of pixels that may lie outside it.

        Args:
            window, step: int64, of shapes that broadcast with each other and with those of row and col; valid.
            row, col: int64, any value.

        Returns:
            int64 of the broadcast shape; that of the last entry of `image` for pixels outside.
        """
        height, width = self.grid.height, self.grid.width
        inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        flat = ((window * self.num_steps + step) * height + row) * width + col
        return torch.where(inside, flat, self.image.numel() - 1)

    def slices_at(self, window: Tensor, step: Tensor, row: Tensor, col: Tensor) -> Tensor:
        """uint8, shape of `index`: the slices at pixels that may lie outside; 0 there."""
        index = self.index(window, step, row, col)
        return self.image.index_select(0, index.reshape(-1)).view(index.shape)

    def at_moved(
        self, image: Tensor, window: Tensor, step: Tensor, row: Tensor, col: Tensor, move: Tensor, which: Tensor
    ) -> Tensor:
        """What an image holds where moves take pixels; 0 outside.

        Args:
            image: (B * S * H * W + 1,), `image` or one of its shape.
            window, step, row, col: (L,) int64, where the pixels stand and the sweep that is looked at.
            move: (T, C, 2) int64, (down, right), pixels; C at least 1.
            which: (L,) int64, the C moves of each pixel.

        Returns:
            (L, C), type of `image`.

        Cost: one look-up each; moves are kept as offsets, so that places are checked only near the border.
        """
        height, width = self.grid.height, self.grid.width
        start = ((window * self.num_steps + step) * height + row) * width + col
        down, right = move.unbind(2)
        index = (down * width + right).index_select(0, which).add_(start[:, None])
        leaves = torch.zeros_like(which, dtype=torch.bool)
        for at, ways, size in ((row, down, height), (col, right, width)):
            leaves |= (at + ways.amin(1).index_select(0, which) < 0) | (
                at + ways.amax(1).index_select(0, which) >= size
            )
        some = flat_nonzero(leaves)
        window, step, row, col, which = (
            values.index_select(0, some)[:, None] for values in (window, step, row, col, which)
        )
        down, right = (ways.index_select(0, which[:, 0]) for ways in (down, right))
        index.index_copy_(0, some, self.index(window, step, row + down, col + right))
        return image.index_select(0, index.view(-1)).view(index.shape)

    @cached_property
    def number(self) -> Tensor:
        """(B * S * H * W + 1,) int32: position of each occupied pixel in the list, P at the last place; undefined for
        what is empty.

        Cost: that of the occupied pixels, once; the rest is not touched.
        """
        number = torch.empty_like(self.image, dtype=torch.int32)
        number[-1:] = self.pixel.numel()
        return number.scatter_(0, self.pixel, torch.arange(self.pixel.numel(), device=number.device).int())

    def number_at(self, place: Tensor) -> Tensor:
        """(K,) int64, position in the list of places (K,) int64 that may be empty: P there."""
        count = self.pixel.numel()
        number = self.number.index_select(0, place).long().clamp_(0, count)
        # Where nothing was written any number may stand: it counts if its pixel is this one.
        return number.masked_fill_(F.pad(self.pixel, (0, 1), value=-1).index_select(0, number) != place, count)

    @cached_property
    def with_around(self) -> Tensor:
        """(B * S * H * W + 1,) uint8: `image`, and in the upper four bits the slices of the 3 x 3 pixels around each.

        Cost: nine look-ups for each occupied pixel, once.
        """
        both, above = self.image.clone(), self.slices << NUM_SLICES
        for down, right in itertools.product((-1, 0, 1), repeat=2):
            # No two pixels have the same place, but outside: there anything may be written.
            place = self.index(self.window, self.step, self.row + down, self.col + right)
            both.index_copy_(0, place, both.index_select(0, place).bitwise_or_(above))
        both[-1:] = 0
        return both

    @cached_property
    def lowest(self) -> Tensor:
        """(P,) float64, metres: height of the lowest point of each occupied pixel."""
        number = self.number.index_select(0, self.place).long()
        return segment_amin(self.batch.positions[2], number, self.pixel.numel() + 1, math.inf)[:-1]

    def coarsen(self, block: int) -> Tuple[Tensor, Tensor]:
        """The same images at pixels of `block` x `block` finest ones.

        Returns:
            images: (B, S, height, width) uint8; a coarse pixel has the slices of all its finest pixels.
            column: (P,) int64 the column of each occupied finest pixel. A column is a coarse pixel whatever the sweep:
                (window * height + row) * width + col.
        """
        height, width = -(-self.grid.height // block), -(-self.grid.width // block)
        shape = (self.num_windows, self.num_steps, height, width)
        row, col = (self.row, self.col) if block == 1 else (divide(self.row, block), divide(self.col, block))
        column = torch.add(col, torch.add(row, self.window, alpha=height), alpha=width)
        if block == 1:
            return self.image[:-1].view(shape), column
        step = torch.add(self.step, self.window, alpha=self.num_steps - 1)
        index = torch.add(column, step, alpha=height * width)
        image = torch.zeros(shape, dtype=torch.uint8, device=column.device)
        for bit in range(NUM_SLICES):
            set_bit(image.view(-1), index.index_select(0, flat_nonzero((self.slices & (1 << bit)).bool())), 1 << bit)
        return image, column


def slice_of(z: Tensor, slice_height: float, num_slices: int = NUM_SLICES) -> Tensor:
    """(N,) uint8: slice of heights (N,) float64, metres, floor(z / slice_height) mod n; 0 for NaN. n: a power of 2, at
    most 16."""
    layer = (z / torch.full((), slice_height, dtype=z.dtype, device=z.device)).floor_()
    layer.clamp_(-_HIGHEST_SLICE, _HIGHEST_SLICE).nan_to_num_(0.0)
    return (layer.long() & (num_slices - 1)).to(torch.uint8)


def set_bit(image: Tensor, index: Tensor, bit: int) -> None:
    """Set a bit of an image at some flat indices. All that write at one write the same: order means nothing."""
    image.index_copy_(0, index, image.index_select(0, index).bitwise_or_(bit))


def count_slices(slices: Tensor) -> Tensor:
    """Set bits, 0 ... 4, of uint8 values below 16; uint8 of the same shape."""
    pairs = (slices & 5) + ((slices >> 1) & 5)
    return (pairs & 3) + (pairs >> 2)
