"""The plane on which most flat spots near the vehicle lie, in whole millimetres."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from cflow_torch.ops.lower_surface import UNKNOWN

FARTHEST = 131.072  # metres; points with larger |x| or |y| are ignored
# Cells are powers of two of a millimetre, so floor division is a shift, also for negative numbers.
_NEAR_BITS, _NEAR_CELLS = 11, 32  # 2.048 m, |x|, |y| < 32.768 m
_STEP, _STEP_BITS = 2, 12  # the tilt is the median step between flat cells 4.096 m apart
_MAX_STEP = 1024  # steeper steps than 25 % are ignored
_FARTHEST_HEIGHT = 1e7  # metres; the largest that fits the sort key
_TRIM = 10  # the lowest tenth of the points of a cell is ignored, because of multipath
_FLAT, _FLAT_POINTS = 250, 4  # a cell of 4 or more points is flat if median - tenth percentile is at most 250 mm
_LAYER = 300  # flat cells of the ground differ by at most this (kerbs), mm
# There is ground if at least 20 pairs of flat cells are level, and at least one per six cells of 4 or more points.
# Simulated drives (seeds 400-409) have at least three times as many pairs, and at most a tenth without their ground.
_FEWEST_PAIRS, _SMALLEST_SHARE = 20, 6


@dataclass(frozen=True)
class Plane:
    """The ground near the vehicle, one plane per sweep."""

    is_there: Tensor  # (B,) bool, False = no ground was found; then the rest is undefined
    step_x: Tensor  # (B,) int64, rise in mm per 4096 mm along x
    step_y: Tensor  # (B,) int64, rise in mm per 4096 mm along y
    height: Tensor  # (B,) int64, mm, at the origin

    def at(self, x: Tensor, y: Tensor, sweep: Tensor) -> Tensor:
        """Return the height of the plane of each point's sweep at x, y, all (N,) int64, mm."""
        rise = self.step_x.index_select(0, sweep).mul_(x).add_(self.step_y.index_select(0, sweep).mul_(y))
        return (rise >> _STEP_BITS).add_(self.height.index_select(0, sweep))


def near_plane(points: Tensor, sweep: Tensor, is_active: Tensor, num_sweeps: int) -> Plane:
    """Fit the plane of most flat cells near the origin to active points, (3, N) int64 mm. Ties: the lowest plane."""
    size = _NEAR_CELLS
    num_cells = num_sweeps * size * size
    statistics = order_statistics(_near_cell(points, sweep, is_active, num_cells), points[2], num_cells)
    low, middle, count = (values.view(num_sweeps, size, size) for values in statistics)
    is_seen = count >= _FLAT_POINTS
    is_flat = is_seen & (middle - low <= _FLAT)
    step_x, num_x = _median_step(low[:, :, :-_STEP], low[:, :, _STEP:], is_flat[:, :, :-_STEP] & is_flat[:, :, _STEP:])
    step_y, num_y = _median_step(low[:, :-_STEP], low[:, _STEP:], is_flat[:, :-_STEP] & is_flat[:, _STEP:])
    pairs = num_x + num_y
    is_there = (pairs >= _FEWEST_PAIRS) & (pairs * _SMALLEST_SHARE >= is_seen.flatten(1).sum(1))

    centre = ((torch.arange(size, device=low.device) - size // 2) << _NEAR_BITS) + (1 << (_NEAR_BITS - 1))
    rise = (step_x[:, None, None] * centre + step_y[:, None, None] * centre[:, None]) >> _STEP_BITS
    height = _largest_layer((low - rise).flatten(1), is_flat.flatten(1))
    return Plane(is_there, step_x, step_y, torch.where(is_there, height, 0))


def _near_cell(points: Tensor, sweep: Tensor, is_active: Tensor, num_cells: int) -> Tensor:
    """Return the cell of each point near the origin, (N,) int64; `num_cells` for other points."""
    size = _NEAR_CELLS
    col, row = (points[:2] >> _NEAR_BITS).add_(size // 2)
    is_near = (((col | row) & -size) == 0).logical_and_(is_active)  # both in 0 ... size - 1
    return (sweep * size).add_(row).mul_(size).add_(col).masked_fill_(~is_near, num_cells)


def _largest_layer(height: Tensor, is_flat: Tensor) -> Tensor:
    """Return the median height of the layer with most flat cells of each sweep, (B,) int64, mm.

    `height` is (B, C) int64, mm above the tilted plane, and `is_flat` is (B, C) bool. Ties: the lowest layer.
    """
    unknown = torch.iinfo(torch.int64).max // 2
    ordered = height.masked_fill_(~is_flat, unknown).sort(1).values
    num_cells = ordered.shape[1]
    rank = torch.arange(num_cells, device=height.device)
    in_layer = torch.searchsorted(ordered, ordered + _LAYER, right=True) - rank  # flat cells up to `_LAYER` above each
    in_layer.masked_fill_(ordered == unknown, 0)
    most = in_layer.amax(1)
    first = torch.where(in_layer == most[:, None], rank, num_cells).amin(1)
    return ordered.gather(1, (first + most // 2)[:, None].clamp_(max=num_cells - 1))[:, 0]


def order_statistics(cell: Tensor, height: Tensor, num_cells: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the tenth percentile, the median and the number of heights in each cell, (num_cells,) int64 each.

    Where the number is 0, the others are undefined. Heights are (N,) int64, mm, |height| < 2^36. Heights in the cell
    `num_cells` are ignored.
    """
    offset = 1 << 36
    bits = 37
    key = (cell << bits).add_(height).add_(offset).sort().values  # by cell, then by height
    count = torch.bincount(cell, minlength=num_cells + 1)[:-1]
    if key.numel() == 0:
        return torch.zeros_like(count), torch.zeros_like(count), count
    ordered = (key & ((1 << bits) - 1)).sub_(offset)
    start = count.cumsum(0).sub_(count)
    last = ordered.numel() - 1
    low, middle = (
        ordered.index_select(0, torch.div(count, part, rounding_mode="floor").add_(start).clamp_(max=last))
        for part in (_TRIM, 2)
    )
    return low, middle, count


def _median_step(first: Tensor, second: Tensor, is_pair: Tensor) -> tuple[Tensor, Tensor]:
    """Return the median of second - first over pairs that are not too steep, and their number, (B,) int64 each."""
    step = second - first
    is_level = is_pair & (step.abs() <= _MAX_STEP)
    ordered = step.masked_fill(~is_level, UNKNOWN).flatten(1).sort(1).values
    number = is_level.flatten(1).sum(1)
    median = ordered.gather(1, (number // 2)[:, None].clamp_(max=ordered.shape[1] - 1))[:, 0]
    return torch.where(number > 0, median, 0), number


def millimetres(positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return (3, N) int64 mm, and (N,) bool: the point is finite and on the grid. Other points move to the origin."""
    x, y, z = positions.abs()
    # A millimetre less than the reach, because rounding must not leave the grid.
    inside = (x < FARTHEST - 0.001).logical_and_(y < FARTHEST - 0.001).logical_and_(z < _FARTHEST_HEIGHT)
    return (positions * 1000).masked_fill_(~inside, 0).round_().long(), inside
