"""Local bias of pairs: which way the surroundings of a pixel seem to shift between t and t+1, by less than a pixel.

A person who moves by half a pixel changes few pixels, so nothing is missing. But sweep t+1 fills more pixels ahead of
him than behind him. Around a static point, noise fills both sides alike.

    slice of t     matched by t+1 to the right only: +1, to the left only: -1, by both or none: 0; likewise down and up
    bias           length of the sum of these vectors over the pixels around, divided by the root of their squares
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.verified.columns import OWN, Columns, Pixels, count_slices

_NUM_SUMS = 3  # times that we sum over 3 x 3 pixels: 7 x 7 pixels, of which those in the middle count most


def local_bias(columns: Columns, pixels: Pixels) -> Tensor:
    """Return the bias around each of K pixels of t, (K,) float32; 0 = none.

    Convention: we sum to the left and right, then up and down, and so on. The sums go only through pixels that have a
        pixel of t within the reach.

    Cost: a few lookups for each column.
    """
    newest = columns.slices[:, 0] & OWN  # [C + 1]
    of_t = columns.slices[:, 1] & OWN
    matched = (columns.beside(newest) & of_t).view(2, 2, -1)  # to the left and right; above and below
    ahead = count_slices(matched[:, 1] & ~matched[:, 0])  # [2, C + 1], to the right; below
    behind = count_slices(matched[:, 0] & ~matched[:, 1])
    x, y = (ahead - behind).short()
    square = x * x + y * y
    sums = torch.stack((x, y, square, torch.zeros_like(square)), 1)  # [C + 1, 4]
    near = -(columns.slices[:, 1:2] > OWN).long()  # [C + 1, 1], all bits or none
    for is_vertical in (False, True) * _NUM_SUMS:
        along = columns.sum_along(sums, is_vertical)  # at most 32 per pixel, and 9^3 pixels: 23328
        sums = (along.view(torch.int64) & near).view(torch.int16)
    x, y, square = sums.index_select(0, columns.column_of(pixels)).float().t()[:3]
    return ((x * x + y * y) / square.clamp(min=1)).sqrt()
