"""Low points that are not drawn: next to a moving object, they move with it.

`HeightSlicedSweeps` leaves out low pixels without a higher one near, because they are often ground that the mask
misses. Far from the sensor, the rings hit a bumper and the bonnet behind it half a metre apart, so a bumper is left
out, too. No comparison sees it. At the end, its points take the motion of the nearest moving pixel:

    from the side           . . .      moving pixels of a car
                      . .              low points in front of it: they move as the car does
           .                           a low point far from it: static
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import constant, draw, flat_nonzero, floor_divide, split_index, take_columns
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_NEAR = 0.5  # metres, rows and columns to a moving pixel
_BESIDE = 1.6  # metres, side of a block
_LOWEST = 10  # centimetres above the mean of the ground around; lower points are ground


def find_low_points(sweeps: HeightSlicedSweeps, is_moving: Tensor) -> tuple[Tensor, Tensor]:
    """Find the points of t that are not drawn, but beside a moving object.

    Args:
        is_moving: (P',) bool, of the pixels.

    Returns:
        row: (K,) int64, row of each of these points in the batch.
        pixel: (K,) int64, the nearest moving pixel of t, at most half a metre away in y and in x. P' + 1 = there is
            none, or the point is less than 0.1 m above the ground.

    Convention: a point is beside an object if the object has a pixel of t in the block of 1.6 m of the point, or in one
    of the eight blocks around. Distances are those between the pixels. Ties: the first pixel in raster order.

    Cost: for each of these points that is at least 0.1 m above the ground, 121 lookups if a pixel is 0.1 m large.
    """
    low = _LowPoints.of(sweeps)
    beside = low.at(flat_nonzero(_are_beside(sweeps, is_moving, low)))
    above = flat_nonzero(beside.is_above)
    pixel = torch.full_like(beside.row, sweeps.num_pixels + 1)
    offset = _nearest_first(sweeps.grid.whole_pixels(_NEAR), above.device)  # [2, M, 1]
    for some in chunks(0, len(above), above.device, offset.shape[1]):
        points = beside.at(above[some])
        pixel[above[some]] = _first_moving(sweeps, is_moving, points.window, points.cell[:, None] + offset)
    return beside.row, pixel


class _LowPoints(NamedTuple):
    """K points of t that are not drawn, because they are low."""

    row: Tensor  # (K,) int64, row of each point in the batch
    window: Tensor  # (K,) int64
    cell: Tensor  # (2, K) int64, row and column of its finest pixel
    is_above: Tensor  # (K,) bool, high enough above the ground to be a part of an object

    @classmethod
    def of(cls, sweeps: HeightSlicedSweeps) -> _LowPoints:
        """Select the points. Without known ground, all points are drawn."""
        batch = sweeps.batch
        of_t = slice(batch.rows[0].start, batch.rows[-1].stop)  # the points of t of all windows
        is_low = batch.is_active[of_t] & batch.has_result[of_t] & ~sweeps.points[of_t].is_member
        row = flat_nonzero(is_low) + of_t.start
        window, _ = split_index(batch.image.index_select(0, row).long(), sweeps.num_steps)
        position = take_columns(batch.positions, row)
        is_above = torch.zeros_like(row, dtype=torch.bool)
        if batch.ground is not None:
            is_above = 100 * position[2] >= batch.ground.at(position, window, batch.ground.mean() + _LOWEST)
        return cls(row, window, torch.stack(sweeps.grid.row_col(position)).long(), is_above)

    def at(self, index: Tensor) -> _LowPoints:
        """Select L of the points, (L,) int64."""
        return _LowPoints(*(values.index_select(-1, index) for values in self))


def _are_beside(sweeps: HeightSlicedSweeps, is_moving: Tensor, points: _LowPoints) -> Tensor:
    """Tell which of K points are beside a moving object, (K,) bool."""
    side = sweeps.grid.whole_pixels(_BESIDE)
    lattice = sweeps.grid.lattice(side, border=1)
    movers = sweeps.pixels[flat_nonzero(is_moving & (sweeps.pixels.step == 1))]
    block = lattice.cell(movers.window, *floor_divide(movers.row_col, side))
    around = (block + lattice.square(1, block.device)).view(-1)
    is_beside = draw(around, sweeps.batch.num_windows * lattice.area)
    return is_beside.index_select(0, lattice.cell(points.window, *floor_divide(points.cell, side)))


def _first_moving(sweeps: HeightSlicedSweeps, is_moving: Tensor, window: Tensor, cell: Tensor) -> Tensor:
    """Return the first moving pixel of t in the cells of each of L points, (L,) int64; P' + 1 = none.

    `window` is (L,) int64, and `cell`, (2, M, L) int64, has rows and columns.
    """
    pixels = sweeps.columns.pixel_in(window, 1, cell, sweeps.num_pixels)  # M L items
    moves = pixels.spread(is_moving, none=False).view(cell.shape[1:])
    first = moves.byte().argmax(0, keepdim=True)
    pixel = pixels.of_item.view(cell.shape[1:]).gather(0, first)[0]
    return torch.where(moves.any(0), pixel, sweeps.num_pixels + 1)


def _nearest_first(reach: int, device: torch.device) -> Tensor:
    """Return the rows and columns to the pixels around, up to `reach` each way, (2, M, 1) int64, the nearest first."""
    line = range(-reach, reach + 1)
    around = sorted(((down, right) for down in line for right in line), key=lambda each: each[0] ** 2 + each[1] ** 2)
    return constant(tuple(around), torch.int64, device).t()[..., None]
