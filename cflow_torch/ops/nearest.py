"""Exact nearest set pixel of a binary image, for a list of pixels."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.indices import split_index

_FAR = 1 << 20  # rows; images have at most 2^15
_COMPARED_AT_ONCE = 1 << 21


def nearest_set_pixel(seeds: Tensor, pixels: Tensor) -> Tensor:
    """Find the nearest seed of each pixel in its image.

    Args:
        seeds: (B, H, W) bool.
        pixels: (P,) int64, flat indices into `seeds`.

    Returns:
        (P,) int64, flat indices into `seeds`; -1 in an image without seeds.

    Convention:
        Euclidean distance between pixels. Ties: the first in raster order.

    Cost: two passes over the images to find the nearest seed of every pixel in its column, then P * W comparisons, one
    seed per column.
    """
    nearest_row = _nearest_row(seeds).flatten(0, 1)  # [B H, W]
    parts = pixels.split(max(1, _COMPARED_AT_ONCE // seeds.shape[2]))
    return torch.cat([_nearest_in_row(nearest_row, part, seeds.shape[1]) for part in parts])


def _nearest_row(seeds: Tensor) -> Tensor:
    """(B, H, W) int64, row of the nearest seed in the column of each pixel, the upper one of two; far if none."""
    row = torch.arange(seeds.shape[1], device=seeds.device)[None, :, None]
    above = torch.where(seeds, row, -_FAR).cummax(1).values
    below = torch.where(seeds, row, _FAR).flip(1).cummin(1).values.flip(1)
    return torch.where(row - above <= below - row, above, below)


def _nearest_in_row(nearest_row: Tensor, pixels: Tensor, height: int) -> Tensor:
    """Compare the nearest seeds of all columns; (P,) int64, as for `nearest_set_pixel`."""
    width = nearest_row.shape[1]
    image_row, col = split_index(pixels, width)
    image, row = split_index(image_row, height)
    seed_row = nearest_row.index_select(0, image_row)  # [P, W]
    seed_col = torch.arange(width, device=pixels.device)
    squared = (seed_row - row[:, None]) ** 2 + (seed_col - col[:, None]) ** 2
    # One number orders the seeds by distance, then by raster order. It fits: 2^31 * 2^30.
    #
    #     squared distance | row | column
    order = squared * (height * width) + seed_row * width + seed_col
    none = torch.iinfo(torch.int64).max
    best = order.masked_fill_(seed_row.abs() >= _FAR, none).amin(1)
    seed = image * (height * width) + best % (height * width)
    return seed.masked_fill_(best == none, -1)
