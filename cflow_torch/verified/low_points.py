"""Low points that are not drawn: next to a moving object, they move with it.

`HeightSlicedSweeps` leaves out low pixels without a higher one near, because they are often ground that the mask
misses. Far from the sensor, the rings hit a bumper and the bonnet behind it half a metre apart, so a bumper is left
out, too. No comparison sees it. At the end, its points take the motion of the nearest moving pixel:

    from the side           . . .      moving pixels of a car
                      . .              low points in front of it: they move as the car does
           .                           a low point far from it: static
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import constant, flat_nonzero, split_index, take_columns
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_NEAR = 0.5  # metres, rows and columns to a moving pixel
_LOWEST = 10  # centimetres above the mean of the ground around; lower points are ground


def find_low_points(sweeps: HeightSlicedSweeps, is_moving: Tensor) -> tuple[Tensor, Tensor]:
    """Find the points of t that are not drawn, but near a moving pixel.

    Args:
        is_moving: (P',) bool, of the pixels.

    Returns:
        row: (K,) int64, row of each of these points in the batch.
        pixel: (K,) int64, the nearest moving pixel of t, at most half a metre away in y and in x.

    Convention: distances are those between the pixels. Ties: the first pixel in raster order.

    Cost: for each point that is not drawn, but at least 0.1 m above the ground, 121 lookups if a pixel is 0.1 m large.
    """
    batch = sweeps.batch
    row = flat_nonzero(batch.is_active & batch.has_result & ~sweeps.points.is_member)
    if batch.ground is None:
        return row[:0], row[:0]
    window, step = split_index(batch.image.index_select(0, row).long(), sweeps.num_steps)
    position = take_columns(batch.positions, row)
    is_above = 100 * position[2] >= batch.ground.at(position, window, batch.ground.mean() + _LOWEST)
    low = flat_nonzero(is_above & (step == 1))
    row, window, position = row[low], window[low], position[:, low]
    offset = _nearest_first(sweeps.grid.whole_pixels(_NEAR), row.device)  # [2, M, 1]
    pixel = torch.empty_like(row)
    for some in chunks(0, len(row), row.device, offset.shape[1]):
        cell = torch.stack(sweeps.grid.row_col(position[:, some])).long()[:, None] + offset  # [2, M, L]
        pixel[some] = _first_moving(sweeps, is_moving, window[some], cell)
    found = flat_nonzero(pixel < sweeps.num_pixels)
    return row[found], pixel[found]


def _first_moving(sweeps: HeightSlicedSweeps, is_moving: Tensor, window: Tensor, cell: Tensor) -> Tensor:
    """Return the first moving pixel of t in the cells of each of L points, (L,) int64; P' = none.

    `window` is (L,) int64, and `cell`, (2, M, L) int64, has rows and columns.
    """
    pixels = sweeps.columns.pixel_in(window, 1, cell, sweeps.num_pixels)  # M L items
    moves = pixels.spread(is_moving, none=False).view(cell.shape[1:])
    first = moves.byte().argmax(0, keepdim=True)
    pixel = pixels.of_item.view(cell.shape[1:]).gather(0, first)[0]
    return torch.where(moves.any(0), pixel, sweeps.num_pixels)


def _nearest_first(reach: int, device: torch.device) -> Tensor:
    """Return the rows and columns to the pixels around, up to `reach` each way, (2, M, 1) int64, the nearest first."""
    line = range(-reach, reach + 1)
    around = sorted(((down, right) for down in line for right in line), key=lambda each: each[0] ** 2 + each[1] ** 2)
    return constant(tuple(around), torch.int64, device).t()[..., None]
