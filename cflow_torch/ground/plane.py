"""The plane on which most flat spots near the vehicle lie, in whole millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.lower_surface import NO_HEIGHT

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
# A key sorts points by cell, then by height:
#
#     bit   63 ... 37   36 ... 0
#           cell        height + 2^36, mm
_HEIGHT_BITS = 37
_LOWEST = 1 << (_HEIGHT_BITS - 1)


@dataclass(frozen=True)
class Points:
    """The points of several sweeps, on a grid of millimetres."""

    position: Tensor  # (3, N) int64, mm; the origin for points that are not active
    sweep: Tensor  # (N,) int64, 0 ... num_sweeps - 1
    is_active: Tensor  # (N,) bool, the point is finite and on the grid
    num_sweeps: int

    @classmethod
    def of(cls, positions: Tensor, sweep: Tensor, num_sweeps: int) -> Points:
        """Round positions, (3, N) float64, metres."""
        x, y, z = positions.abs()
        reach = FARTHEST - 0.001  # because rounding must not leave the grid
        is_active = (x < reach).logical_and_(y < reach).logical_and_(z < _FARTHEST_HEIGHT)
        return cls((positions * 1000).masked_fill_(~is_active, 0).round_().long(), sweep, is_active, num_sweeps)

    def cell(self, bits: int, size: int) -> Tensor:
        """Return the cell of each active point, (N,) int64, in one image of size x size cells of 2^bits mm per sweep.

        Other points, and those beyond the images, have the index after the last cell.
        """
        col, row = (self.position[:2] >> bits).add_(size // 2)
        is_inside = (((col | row) & -size) == 0).logical_and_(self.is_active)  # both in 0 ... size - 1
        cell = (self.sweep * size).add_(row).mul_(size).add_(col)
        return cell.masked_fill_(~is_inside, self.num_sweeps * size * size)


@dataclass(frozen=True)
class Plane:
    """The ground near the vehicle, one plane per sweep."""

    is_there: Tensor  # (B,) bool, False = no ground was found; then the rest is undefined
    step_x: Tensor  # (B,) int64, rise in mm per 4096 mm along x
    step_y: Tensor  # (B,) int64, rise in mm per 4096 mm along y
    height: Tensor  # (B,) int64, mm, at the origin

    def heights(self, points: Points) -> Tensor:
        """Return the height of each point above the plane of its sweep, (N,) int64, mm."""
        x, y, z = points.position
        rise = self.step_x.index_select(0, points.sweep).mul_(x)
        rise += self.step_y.index_select(0, points.sweep).mul_(y)
        return z - (rise >> _STEP_BITS).add_(self.height.index_select(0, points.sweep))


@dataclass(frozen=True)
class CellHeights:
    """The heights of the points in each cell, (B, size, size) int64; undefined in a cell without points."""

    low: Tensor  # mm, the tenth percentile
    middle: Tensor  # mm, the median
    count: Tensor  # of points

    @classmethod
    def of(cls, points: Points, height: Tensor, cell: Tensor, size: int) -> CellHeights:
        """Sort the heights of points, (N,) int64, mm, |height| < 2^36, by their cells, see `Points.cell`."""
        shape = (points.num_sweeps, size, size)
        count = torch.bincount(cell, minlength=points.num_sweeps * size * size + 1)[:-1]
        if len(cell) == 0:
            return cls(count.view(shape), count.view(shape), count.view(shape))
        key = (cell << _HEIGHT_BITS).add_(height).add_(_LOWEST).sort().values
        ordered = (key & ((1 << _HEIGHT_BITS) - 1)).sub_(_LOWEST)
        start = count.cumsum(0).sub_(count)

        def at(rank: Tensor) -> Tensor:
            """Return the height of this rank in each cell."""
            return ordered.index_select(0, (start + rank).clamp_(max=len(ordered) - 1)).view(shape)

        return cls(
            low=at(torch.div(count, _TRIM, rounding_mode="floor")),
            middle=at(torch.div(count, 2, rounding_mode="floor")),
            count=count.view(shape),
        )


def near_plane(points: Points) -> Plane:
    """Fit the plane of most flat cells near the origin. Ties: the lowest plane."""
    cells = CellHeights.of(points, points.position[2], points.cell(_NEAR_BITS, _NEAR_CELLS), _NEAR_CELLS)
    is_seen = cells.count >= _FLAT_POINTS
    is_flat = is_seen & (cells.middle - cells.low <= _FLAT)
    along_x = _Steps.of(cells.low, is_flat, axis=2)
    along_y = _Steps.of(cells.low, is_flat, axis=1)

    num_pairs = along_x.num_pairs + along_y.num_pairs
    is_there = num_pairs >= _FEWEST_PAIRS
    is_there &= num_pairs * _SMALLEST_SHARE >= is_seen.flatten(1).sum(1)

    # The height of the tilted plane through the origin, at the middle of each cell.
    middle = torch.arange(-(_NEAR_CELLS // 2), _NEAR_CELLS // 2, device=is_there.device) << _NEAR_BITS
    middle += 1 << (_NEAR_BITS - 1)
    rise = along_x.median[:, None, None] * middle + along_y.median[:, None, None] * middle[:, None]
    rise >>= _STEP_BITS
    height = _largest_layer((cells.low - rise).flatten(1), is_flat.flatten(1))
    return Plane(is_there, along_x.median, along_y.median, torch.where(is_there, height, 0))


def _largest_layer(height: Tensor, is_flat: Tensor) -> Tensor:
    """Return the median height of the layer with most flat cells of each sweep, (B,) int64, mm.

    `height` is (B, C) int64, mm above the tilted plane, and `is_flat` is (B, C) bool. Ties: the lowest layer.
    """
    unknown = torch.iinfo(torch.int64).max // 2
    ordered = height.masked_fill_(~is_flat, unknown).sort(1).values
    num_cells = ordered.shape[1]
    rank = torch.arange(num_cells, device=height.device)
    # Flat cells up to `_LAYER` above each.
    in_layer = torch.searchsorted(ordered, ordered + _LAYER, right=True) - rank  # [B, C]
    in_layer.masked_fill_(ordered == unknown, 0)
    most = in_layer.amax(1)
    first = torch.where(in_layer == most[:, None], rank, num_cells).amin(1)
    return _of_rows(ordered, first + most // 2)


class _Steps(NamedTuple):
    """The steps between pairs of flat cells of each sweep, without those that are too steep; (B,) int64 each."""

    median: Tensor  # mm, 0 without a pair
    num_pairs: Tensor

    @classmethod
    def of(cls, low: Tensor, is_flat: Tensor, axis: int) -> _Steps:
        """Compare heights, (B, rows, columns) int64, mm, with those `_STEP` cells further along an axis."""
        length = low.shape[axis] - _STEP
        step = low.narrow(axis, _STEP, length) - low.narrow(axis, 0, length)
        is_level = step.abs() <= _MAX_STEP
        is_level &= is_flat.narrow(axis, _STEP, length)
        is_level &= is_flat.narrow(axis, 0, length)
        ordered = step.masked_fill_(~is_level, NO_HEIGHT).flatten(1).sort(1).values
        num_pairs = is_level.flatten(1).sum(1)
        median = _of_rows(ordered, num_pairs // 2)
        return cls(torch.where(num_pairs > 0, median, 0), num_pairs)


def _of_rows(values: Tensor, column: Tensor) -> Tensor:
    """Return the value of each row, (R, C), in its own column, (R,), or in the last one if that is beyond it."""
    return values.gather(1, column[:, None].clamp_(max=values.shape[1] - 1))[:, 0]
