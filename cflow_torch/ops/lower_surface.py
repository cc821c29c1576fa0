"""A smooth lower surface of height maps, many maps at once, in whole millimetres."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

UNKNOWN = 1 << 29  # height of an empty cell; sums with it still fit an int32
_SUPPORT = 300  # neighbours at about the same height, mm; low points without such neighbours are multipath
_STEEP, _GENTLE = 164, 51  # mm per cell: 16 % for hills, 5 % about the smoothed hills (cells of a metre)
_ROUGH = 70  # mm above the surface at which a cell is still part of it
_SMOOTH = 10  # cells on each side that the hills are smoothed over


def lower_surface(low: Tensor) -> Tensor:
    """The highest surface of limited slope below the heights: what stands on the ground is steeper than the ground.

    Args:
        low: (B, H, W) int32, mm, lowest height of each cell; `UNKNOWN` = empty.

    Returns:
        (B, H, W) int32, mm, also where nothing is known.

    Convention: done twice, first with slopes as steep as hills, then, about the smoothed result, with gentle ones.
    Whole numbers throughout, so the same bits on any device.

    Cost: some sixty passes over the maps.
    """
    is_supported = _is_supported(low)
    hills = _box_mean(_gentlest(low.masked_fill(~is_supported, UNKNOWN), _STEEP))
    rest = low - hills
    # A point without neighbours, as far rings have many, is believed unless it is a hole in the hills.
    believed = (is_supported | (rest >= -_SUPPORT)).logical_and_(low < UNKNOWN)
    return _gentlest(rest.masked_fill_(~believed, UNKNOWN), _GENTLE).add_(hills)


def _is_supported(low: Tensor) -> Tensor:
    """(B, H, W) bool: three of the eight neighbours, or half of the occupied ones, are at about the same height."""
    height, width = low.shape[1:]
    padded = F.pad(low, (1, 1, 1, 1), value=UNKNOWN)
    similar, occupied = torch.zeros_like(low, dtype=torch.uint8), torch.zeros_like(low, dtype=torch.uint8)
    for down in range(3):
        for right in range(3):
            if (down, right) != (1, 1):
                neighbour = padded[:, down : down + height, right : right + width]
                similar += (neighbour - low).abs_() <= _SUPPORT
                occupied += neighbour < UNKNOWN
    return (similar * 2 >= occupied.clamp(max=6)) & (occupied > 0) & (low < UNKNOWN)


def _gentlest(heights: Tensor, slope: int) -> Tensor:
    """The surface of limited slope through the heights that no other height forbids, also where there is none.

    Args:
        heights: (B, H, W) int32, mm; `UNKNOWN` = unknown.
        slope: mm per cell, along rows and along columns.

    Convention: between known cells the middle of the highest and the lowest possible surface.
    """
    is_ground = (heights - _cone(heights, slope) <= _ROUGH).logical_and_(heights < UNKNOWN)
    both = torch.cat([heights, -heights]).masked_fill_(~is_ground.repeat(2, 1, 1), UNKNOWN)
    highest, lowest = _cone(both, slope).split(len(heights))
    return (highest - lowest) >> 1


def _cone(heights: Tensor, slope: int) -> Tensor:
    """(B, H, W) the highest surface of limited slope on or below all heights: min over q of h(q) + slope |p - q|."""
    for _ in range(2):  # along rows, then, transposed, along columns
        ramp = torch.arange(heights.shape[2], dtype=torch.int32, device=heights.device) * slope
        upwards = (heights - ramp).cummin(2).values.add_(ramp)
        downwards = (heights + ramp).flip(2).cummin(2).values.flip(2).sub_(ramp)
        heights = torch.minimum(upwards, downwards).transpose(1, 2).contiguous()
    return heights


def _box_mean(heights: Tensor) -> Tensor:
    """(B, H, W) int32 mean over the square around each cell, as far as it lies inside."""
    span, height, width = _SMOOTH, heights.shape[1], heights.shape[2]
    table = F.pad(heights.cumsum(1, dtype=torch.int64).cumsum(2), (1, 0, 1, 0))
    place = torch.arange(max(height, width), device=heights.device)
    top, bottom = (place[:height] - span).clamp_(min=0), (place[:height] + span + 1).clamp_(max=height)
    left, right = (place[:width] - span).clamp_(min=0), (place[:width] + span + 1).clamp_(max=width)
    rows = table.index_select(1, bottom) - table.index_select(1, top)
    total = rows.index_select(2, right) - rows.index_select(2, left)
    area = (bottom - top)[:, None] * (right - left)
    return torch.div(total, area, rounding_mode="floor").int()
