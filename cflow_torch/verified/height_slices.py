"""The finest images of all sweeps with four height slices a pixel, and the list of their occupied pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, occupied, split_index
from cflow_torch.types import CFlowError
from cflow_torch.verified.ground_residue import TALL, empty_low_columns, ground_heights, is_tall
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

# Height slices are told apart by this many numbers, then they repeat: 2 m of four slices of 0.5 m.
NUM_SLICES = 4
# Beyond this float64 only holds multiples of 16, so cutting heights off here changes no slice.
_HIGHEST_SLICE = 2.0**56


@dataclass(frozen=True)
class Cells:
    """Four bits a pixel for every sweep of every window, and where any of them is set.

    Args:
        grid: the BEV of the images.
        num_windows, num_steps: B, S; step 0 = sweep t+1, 1 = t, ...
        image: (B * S * H * W + 1,) uint8, bit c = a point of height slice c lies there; the last entry, always 0, is
            for whatever lies outside the images.
        pixel: (P,) int64, flat indices of the occupied pixels, ascending.
        window, step, row, col: (P,) int64, where each of them lies.
        slices: (P,) uint8, what `image` holds there.
    """

    grid: Grid
    num_windows: int
    num_steps: int
    image: Tensor
    pixel: Tensor
    window: Tensor
    step: Tensor
    row: Tensor
    col: Tensor
    slices: Tensor

    def place(self, window: Tensor, step: Tensor, row: Tensor, col: Tensor) -> Tensor:
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

    def look_up(self, place: Tensor) -> Tensor:
        """uint8, shape of `place`: the slices at flat indices of any shape."""
        return self.image.index_select(0, place.reshape(-1)).view(place.shape)

    def number(self) -> Tensor:
        """(B * S * H * W + 1,) int32: position of each pixel in the list, P where none is occupied.

        Cost: one pass over the images; make it once.
        """
        number = torch.full_like(self.image, self.pixel.numel(), dtype=torch.int32)
        return number.scatter_(0, self.pixel, torch.arange(self.pixel.numel(), device=number.device).int())

    def number_at_t(self) -> Tensor:
        """The same for points of sweep t: undefined for what is empty and for other sweeps, P at the last place.

        Cost: that of the pixels of t; the rest is not touched.
        """
        number = torch.empty_like(self.image, dtype=torch.int32)
        at_t = flat_nonzero(self.step == 1)
        number[-1:] = self.pixel.numel()
        return number.scatter_(0, self.pixel.index_select(0, at_t), at_t.int())


def make_cells(
    batch: Batch, grid: Grid, slice_height: float, clearance: Optional[float] = None
) -> Tuple[Cells, Tensor]:
    """Draw every sweep of a batch with its height slices.

    Args:
        batch: positions with three axes, frame of t+1.
        grid: the finest BEV.
        slice_height: metres.
        clearance: metres; pixels that do not stand out of the ground of the batch by this much are left out, see
            `empty_low_columns`. None = all are drawn.

    Returns:
        cells: of all windows.
        place: (N,) int64, flat index into `cells.image` of every point; its last entry for those that take no part or
            lie on a pixel that is left out.

    Convention:
        The slice of a height z is floor(z / slice_height) mod 4 in float64, the division a true one (see `Grid.pixel`).

    Raises:
        CFlowError: the batch holds no heights.

    Cost: linear in points and pixels.
    """
    if len(batch.positions) != 3:
        raise CFlowError("height slices need z: make the batch with three axes")
    num_images, num_points, device = batch.num_windows * batch.num_steps, batch.image.numel(), batch.image.device
    heights = None if clearance is None or batch.ground is None else ground_heights(batch.ground)
    image = torch.zeros(num_images * grid.height * grid.width + 1, dtype=torch.uint8, device=device)
    place = torch.empty(num_points, dtype=torch.int64, device=device)
    for points in chunks(0, num_points, device):
        positions, takes_part = batch.positions[:, points], batch.takes_part[points]
        place[points] = at = grid.pixel_of_image(positions, batch.image[points], num_images, takes_part).long()
        # Rows that take no part have any slice: what they draw is wiped off.
        draw_slices(image, at, slice_of(positions[2], slice_height))
        if heights is not None and clearance is not None:
            draw_bit(image, is_tall(at, positions, heights, grid, batch.num_steps, clearance), TALL)
    image[-1:] = 0
    pixel = occupied(image)
    if heights is not None:
        pixel = empty_low_columns(image, pixel, grid)
        place = torch.where(image.index_select(0, place) != 0, place, image.numel() - 1)
    return _listed(image, pixel, grid, batch.num_windows, batch.num_steps), place


def slice_of(z: Tensor, slice_height: float, num_slices: int = NUM_SLICES) -> Tensor:
    """(N,) uint8: slice of heights (N,) float64, metres, as in `make_cells`; 0 for NaN. At most 16, a power of 2."""
    layer = (z / torch.full((), slice_height, dtype=z.dtype, device=z.device)).floor_()
    layer.clamp_(-_HIGHEST_SLICE, _HIGHEST_SLICE).nan_to_num_(0.0)
    return (layer.long() & (num_slices - 1)).to(torch.uint8)


def draw_slices(image: Tensor, place: Tensor, part: Tensor) -> None:
    """Set a bit for every slice that a point lies in.

    Args:
        image: (Q,) uint8, drawn into.
        place: (N,) int64, where in it each point lies.
        part: (N,) uint8, slice of each point.
    """
    for index in range(NUM_SLICES):
        draw_bit(image, place.index_select(0, flat_nonzero(part == index)), 1 << index)


def draw_bit(image: Tensor, place: Tensor, bit: int) -> None:
    """Set a bit of an image at some places. What is written at a place is the same for all, so order means nothing."""
    image.index_copy_(0, place, image.index_select(0, place).bitwise_or_(bit))


def cells_of_image(image: Tensor, grid: Grid, num_windows: int, num_steps: int) -> Cells:
    """List the occupied pixels of an image.

    Args:
        image: (B * S * H * W + 1,) uint8, as in `Cells`.
        grid: the BEV.
        num_windows, num_steps: B, S.
    """
    return _listed(image, occupied(image), grid, num_windows, num_steps)


def _listed(image: Tensor, pixel: Tensor, grid: Grid, num_windows: int, num_steps: int) -> Cells:
    """The same, where its occupied pixels are known."""
    of_image, within = split_index(pixel, grid.height * grid.width)
    window, step = split_index(of_image, num_steps)
    row, col = split_index(within, grid.width)
    slices = image.index_select(0, pixel)
    return Cells(grid, num_windows, num_steps, image, pixel, window, step, row, col, slices)


def count_slices(slices: Tensor) -> Tensor:
    """Set bits, 0 ... 4, of uint8 values below 16; uint8 of the same shape."""
    pairs = (slices & 5) + ((slices >> 1) & 5)
    return (pairs & 3) + (pairs >> 2)
