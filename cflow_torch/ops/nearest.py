"""Exact nearest set pixel of a binary image, for a list of pixels."""

from __future__ import annotations

import torch
from torch import Tensor

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
    _, height, width = seeds.shape
    rows = torch.arange(height, device=seeds.device)[None, :, None]
    above = torch.where(seeds, rows, -_FAR).cummax(1).values
    below = torch.where(seeds, rows, _FAR).flip(1).cummin(1).values.flip(1)
    nearest_row = torch.where(rows - above <= below - rows, above, below).flatten(0, 1)  # (B * H, W)
    cols = torch.arange(width, device=seeds.device)
    found = []
    for part in pixels.split(max(1, _COMPARED_AT_ONCE // width)):
        line = part // width
        col, row = part - line * width, line % height
        seed_row = nearest_row.index_select(0, line)
        squared = (seed_row - row[:, None]) ** 2 + (cols - col[:, None]) ** 2
        # One number orders the seeds by distance, then by raster order. It fits: 2^31 * 2^30.
        order = squared * (height * width) + seed_row * width + cols
        order.masked_fill_(seed_row.abs() >= _FAR, torch.iinfo(torch.int64).max)
        best = order.amin(1)
        pixel = (line - row) * width + best % (height * width)
        found.append(torch.where(best == torch.iinfo(torch.int64).max, -1, pixel))
    return torch.cat(found) if found else pixels.clone()
