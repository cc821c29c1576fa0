"""Fit a smooth surface below height maps, many maps at once, in whole millimetres."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

NO_HEIGHT = 1 << 29  # height of an empty cell; sums with it still fit an int32
_SUPPORT = 300  # height difference of similar neighbours, mm; low points without such neighbours are multipath
_STEEP, _GENTLE = 164, 51  # mm per cell: 16 % for hills, 5 % about the smoothed hills (cells of a metre)
_ROUGH = 70  # mm; cells up to this height above the surface belong to it
# The cells around a cell, counted down and to the right from the one above and to the left of it.
_NEIGHBOURS = tuple((down, right) for down in range(3) for right in range(3) if (down, right) != (1, 1))
_SMOOTH = 10  # cells on each side over which we smooth the hills


def lower_surface(low: Tensor) -> Tensor:
    """Fit the highest surface of limited slope below the heights, apart from low outliers. Objects rise more steeply.

    Args:
        low: (B, H, W) int32, mm, a low height of each cell, such as its tenth percentile; `NO_HEIGHT` = empty. In the
            middle of the map, the ground is at 0.

    Returns:
        (B, H, W) int32, mm; undefined in empty cells.

    Convention: the first fit allows slopes as steep as hills, and we smooth its surface. The second fit allows gentle
    slopes relative to the smoothed surface. All numbers are integers, so the bits are the same on any device.

    Cost: about sixty passes over the maps; on a CPU, over their part with heights.
    """
    lowest = _lowest(low)
    if low.device.type != "cpu":  # a GPU would wait for the rows and columns of this part
        return _surface(low, lowest)
    rows, cols = (_part((low < NO_HEIGHT).any(2).any(0)), _part((low < NO_HEIGHT).any(1).any(0)))
    surface = low.new_zeros(low.shape)
    surface[:, rows, cols] = _surface(low[:, rows, cols], lowest[rows, cols])
    return surface


def _part(is_known: Tensor) -> slice:
    """Return the rows or columns from the first to the last known one, with those over which we smooth around them."""
    known = is_known.nonzero()[:, 0].tolist() or [0]
    return slice(max(known[0] - _SMOOTH, 0), known[-1] + _SMOOTH + 1)


def _surface(low: Tensor, lowest: Tensor) -> Tensor:
    """Fit the surface to maps, (B, H, W). `lowest` is that of their cells, (H, W)."""
    is_supported = _is_supported(low) & (low >= lowest)
    hills = _box_mean(_gentlest(low.masked_fill(~is_supported, NO_HEIGHT), _STEEP))
    rest = low - hills
    # Far rings have many cells without similar neighbours. Such a cell counts unless it is far below the hills.
    is_trusted = (is_supported | (rest >= -_SUPPORT)).logical_and_(low < NO_HEIGHT)
    return _gentlest(rest.masked_fill_(~is_trusted, NO_HEIGHT), _GENTLE).add_(hills)


def _is_supported(low: Tensor) -> Tensor:
    """(B, H, W) bool: three of the eight neighbours, or half of the occupied ones, have a similar height."""
    height, width = low.shape[1:]
    padded = F.pad(low, (1, 1, 1, 1), value=NO_HEIGHT)
    num_similar = torch.zeros_like(low, dtype=torch.uint8)
    num_occupied = torch.zeros_like(low, dtype=torch.uint8)
    for down, right in _NEIGHBOURS:
        neighbour = padded[:, down : down + height, right : right + width]
        num_similar += (neighbour - low).abs_() <= _SUPPORT
        num_occupied += neighbour < NO_HEIGHT
    is_similar = num_similar * 2 >= num_occupied.clamp(max=6)
    return is_similar & (num_occupied > 0) & (low < NO_HEIGHT)


def _lowest(low: Tensor) -> Tensor:
    """Return how low the ground may be in each cell, (H, W) int32, mm, if it falls from the middle like the hills.

    Several points of a mirrored object support one another, and are often many metres below the ground.
    """
    height, width = low.shape[1:]
    rows = (torch.arange(height, dtype=torch.int32, device=low.device) - height // 2).abs_()
    cols = (torch.arange(width, dtype=torch.int32, device=low.device) - width // 2).abs_()
    return (rows[:, None] + cols).mul_(-_STEEP).sub_(_SUPPORT)


def _gentlest(heights: Tensor, slope: int) -> Tensor:
    """The surface of limited slope through all heights at most `_ROUGH` above `_cone`, defined everywhere.

    Between known cells, it is the mean of the highest and the lowest possible surface. The slope is in mm per cell.
    """
    is_ground = (heights - _cone(heights, slope) <= _ROUGH).logical_and_(heights < NO_HEIGHT)
    both = torch.cat([heights, -heights]).masked_fill_(~is_ground.repeat(2, 1, 1), NO_HEIGHT)
    highest, lowest = _cone(both, slope).split(len(heights))
    return (highest - lowest) >> 1


def _cone(heights: Tensor, slope: int) -> Tensor:
    """(B, H, W) highest surface of limited slope on or below all heights: min over q of h(q) + slope |p - q|."""
    for _ in range(2):  # along rows, then, transposed, along columns
        ramp = torch.arange(heights.shape[2], dtype=torch.int32, device=heights.device) * slope
        upwards = (heights - ramp).cummin(2).values.add_(ramp)
        downwards = (heights + ramp).flip(2).cummin(2).values.flip(2).sub_(ramp)
        heights = torch.minimum(upwards, downwards).transpose(1, 2).contiguous()
    return heights


def _box_mean(heights: Tensor) -> Tensor:
    """(B, H, W) int32 mean over the part of the square around each cell that is inside."""
    _, height, width = heights.shape
    table = F.pad(heights.cumsum(1, dtype=torch.int64).cumsum(2), (1, 0, 1, 0))
    top, bottom = _neighbourhood(height, heights.device)
    left, right = _neighbourhood(width, heights.device)
    rows = table.index_select(1, bottom) - table.index_select(1, top)
    total = rows.index_select(2, right) - rows.index_select(2, left)
    area = (bottom - top)[:, None] * (right - left)
    return torch.div(total, area, rounding_mode="floor").int()


def _neighbourhood(size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """First cell, and end, of the cells about each of a row of cells, (size,) int64 each."""
    cell = torch.arange(size, device=device)
    return (cell - _SMOOTH).clamp(min=0), (cell + _SMOOTH + 1).clamp(max=size)
