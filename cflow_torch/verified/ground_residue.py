"""Low columns are ground: what a ground mask left over, found by its height above the ground around it.

Remnants of the ground look different in every sweep, so they seem to move. A pixel belongs to an object only if
something on it, or next to it, stands clearly above the ground points around; a curb or a bump does not.
"""

from __future__ import annotations

from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.windows.bev_grid import Grid

# Side of the blocks in which the height of the ground is averaged, metres; with the eight blocks around, 6 m x 6 m.
_BLOCK = 2.0
# Fewer ground points than this in 6 m x 6 m say nothing.
_LEAST_POINTS = 5
# How far from a tall pixel a low one still belongs to its object, pixels.
_REACH = 2
# Bit of a pixel with a point that stands out of the ground, above those of its slices.
TALL = 16
# Heights are whole centimetres, bounded so that no sum overflows; unknown ground lies deeper than any point.
_HIGHEST = 10**10
_UNKNOWN = -(1 << 40)


def no_ground(num_windows: int, grid: Grid, device: torch.device) -> Tensor:
    """(2, B, Y, X) int64 zeros: sum of heights in centimetres and number of points, of blocks of 2 m x 2 m."""
    return torch.zeros((2, num_windows, *_num_blocks(grid)), dtype=torch.int64, device=device)


def add_ground(sums: Tensor, window: int, positions: Tensor, grid: Grid) -> None:
    """Count ground points of a sweep, or of a piece of it, in `sums`.

    Args:
        sums: (2, B, Y, X) int64, as made by `no_ground`; changed in place.
        window: index of the window.
        positions: (3, N) float64, metres, frame of t+1, inside the region.
        grid: the region.

    Convention: sums of integers, so neither the order of the points nor that of the pieces matters.
    Cost: linear in N.
    """
    block = _block(positions, grid)
    heights, count = sums[:, window].view(2, -1).unbind(0)
    heights.index_add_(0, block, _centimetres(positions[2]))
    count.index_add_(0, block, torch.ones_like(block, dtype=torch.int64))


def ground_heights(sums: Tensor) -> Tensor:
    """Mean height of the ground around each block.

    Args:
        sums: (2, B, Y, X) int64, of all the ground points that are to count (those of t and t+1).

    Returns:
        (B, Y, X) int64, centimetres: mean over 3 x 3 blocks, rounded down; far below everything where they hold fewer
        than five points.

    Cost: a few operations on some thousand blocks.
    """
    _, _, rows, cols = sums.shape
    wide = F.pad(sums, (1, 1, 1, 1))
    around = torch.zeros_like(sums)
    for down in range(3):
        for right in range(3):
            around += wide[:, :, down : down + rows, right : right + cols]
    heights, count = around.unbind(0)
    mean = torch.div(heights, count.clamp(min=1), rounding_mode="floor")
    return torch.where(count >= _LEAST_POINTS, mean, torch.full_like(mean, _UNKNOWN))


def is_tall(place: Tensor, positions: Tensor, ground: Tensor, grid: Grid, num_steps: int, clearance: float) -> Tensor:
    """Where points lie that stand out of the ground.

    Args:
        place: (P,) int64, flat index into (B, S, H, W) images; B * S * H * W for points that are left out.
        positions: (3, P) float64, metres, frame of t+1; of points that are left out it means nothing.
        ground: (B, Y, X) int64, as `ground_heights` gives it.
        grid: of the images.
        num_steps: S.
        clearance: metres; used to the centimetre.

    Returns:
        (K,) int64, places of the points that lie `clearance` or more above the ground of the block that they are in;
        places come again if several do.

    Convention: heights are compared in whole centimetres, each rounded down.
    Cost: some ten passes over the points.
    """
    area, (rows, cols) = grid.height * grid.width, ground.shape[1:]
    block = torch.add(_block(positions, grid), divide(place, num_steps * area), alpha=rows * cols)
    block.clamp_(0, ground.numel() - 1)  # that of points which are left out may be anything
    least = (ground.reshape(-1) + round(100 * clearance)).double().index_select(0, block)
    # A whole number is at most a number rounded down if it is at most the number.
    is_high = (positions[2] * 100).clamp_(-_HIGHEST, _HIGHEST) >= least
    return place.index_select(0, flat_nonzero(is_high & (place < len(ground) * num_steps * area)))


def empty_low_columns(image: Tensor, pixel: Tensor, grid: Grid) -> Tensor:
    """Empty the pixels that are ground, and take all marks of tall ones off.

    A pixel stays if it is tall, or one of the same sweep at most two rows and two columns away is.

    Args:
        image: (B * S * H * W + 1,) uint8, bits of the slices of each pixel, and `TALL` where a point is tall; the last
            entry, 0, is for whatever lies outside. Changed in place.
        pixel: (P,) int64, flat indices of its occupied pixels, ascending.
        grid: of the images.

    Returns:
        Those of them that stay.

    Cost: 25 look-ups for every pixel without a tall point.
    """
    slices = image.index_select(0, pixel)
    low = pixel.index_select(0, flat_nonzero(slices < TALL))
    lone = low.index_select(0, flat_nonzero(~_is_near_tall(image, low, grid)))
    image.index_copy_(0, pixel, slices.bitwise_and_(TALL - 1))
    image.index_fill_(0, lone, 0)
    return pixel.index_select(0, flat_nonzero(image.index_select(0, pixel)))


def _is_near_tall(image: Tensor, pixels: Tensor, grid: Grid) -> Tensor:
    """(K,) bool: is a tall pixel at most `_REACH` rows and columns away from each of these flat indices?"""
    image_row, col = split_index(pixels, grid.width)
    number, row = split_index(image_row, grid.height)
    first = number * (grid.height * grid.width)
    reach = range(-_REACH, _REACH + 1)
    # Beyond the border the border's pixel is looked up, which is as near.
    cols = [(col + right).clamp_(0, grid.width - 1) for right in reach]
    highest = torch.zeros(len(pixels), dtype=torch.uint8, device=pixels.device)
    for down in reach:
        start = torch.add(first, (row + down).clamp_(0, grid.height - 1), alpha=grid.width)
        for other_col in cols:
            highest = torch.maximum(highest, image.index_select(0, start + other_col))
    return highest >= TALL


def _num_blocks(grid: Grid) -> Tuple[int, int]:
    return (
        int((grid.upper[1] - grid.lower[1]) / _BLOCK) + 1,
        int((grid.upper[0] - grid.lower[0]) / _BLOCK) + 1,
    )


def _block(positions: Tensor, grid: Grid) -> Tensor:
    """(N,) int32 block of (3, N) positions inside the region; nothing there is below the lower end."""
    row = (positions[1] - grid.lower[1]).div_(_BLOCK).int()
    col = (positions[0] - grid.lower[0]).div_(_BLOCK).int()
    return col.add_(row, alpha=_num_blocks(grid)[1])


def _centimetres(z: Tensor) -> Tensor:
    """(N,) int64 height, rounded down."""
    return torch.floor(z * 100).clamp_(-_HIGHEST, _HIGHEST).long()
