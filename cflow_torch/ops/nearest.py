"""Nearest set pixel of a binary image, exactly, at the pixels that ask for it."""

from __future__ import annotations

import torch
from torch import Tensor

_FAR = 1 << 20  # rows; images have at most 2^15
_COMPARED_AT_ONCE = 1 << 21


def nearest_set_pixel(seeds: Tensor, pixels: Tensor) -> Tensor:
    """For each pixel the nearest seed of the same image.

    Args:
        seeds: (B, H, W) bool.
        pixels: (P,) int64, flat indices into `seeds`.

    Returns:
        (P,) int64, flat index into `seeds`; -1 in an image without seeds.

    Convention:
        Euclidean distance between pixels; ties: the seed that is first in raster order.

    Cost: two passes over the images, then P * W comparisons: the nearest seed of each column is known, so a pixel looks
    at one seed per column.
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
        # One number that orders seeds: distance, then place in the image. It fits: 2^31 * 2^30.
        order = squared * (height * width) + seed_row * width + cols
        order.masked_fill_(seed_row.abs() >= _FAR, torch.iinfo(torch.int64).max)
        best = order.amin(1)
        place = (line - row) * width + best % (height * width)
        found.append(torch.where(best == torch.iinfo(torch.int64).max, -1, place))
    return torch.cat(found) if found else pixels.clone()
