"""Ground residue: what a ground mask left over, found by its height above the ground around it.

Residues of the ground look different in every sweep, so they seem to move. A pixel belongs to an object only if
something on it, or next to it, stands clearly above the ground points around; a curb or a bump does not.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.windows.bev_grid import Grid

# How far from a tall pixel a low one still belongs to its object, pixels.
_REACH = 2
# Bit of a pixel with a point that stands out of the ground, above those of its slices.
TALL = 16


def is_tall(z: Tensor, ground: Tensor, min_height: float) -> Tensor:
    """(N,) bool: which points stand out of the ground.

    Args:
        z: (N,) float64, metres, frame of t+1.
        ground: (N,) float64, height of the ground around each, whole centimetres, as `GroundHeights.below` gives it.
        min_height: metres; used to the centimetre.
    """
    return z * 100 >= ground + round(100 * min_height)


def clear_ground_residue(image: Tensor, pixel: Tensor, grid: Grid) -> Tensor:
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
