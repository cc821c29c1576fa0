"""The spacing of points: how far apart the beams of a sweep hit a surface, which grows with the distance.

A sparse sensor hits a static surface at other positions in every sweep. So a slice is missing at a position only if no
point is within the spacing there: in the *reach* around, 3 x 3 pixels where the spacing is less than a pixel. A pixel
is *wide* if its reach is larger, and *tall* if neighbouring rings are farther apart than a slice is high. There, the
slices above and below count as well.
"""

from __future__ import annotations

import math
from typing import Callable, NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import constant, divide, draw, flat_nonzero, floor_divide, split_index, take_columns
from cflow_torch.verified.directions import azimuth_bin, elevation_bin
from cflow_torch.windows.bev_grid import Grid, Lattice
from cflow_torch.windows.collation import Batch

# Bins of directions: fine azimuths in rows of a degree of elevation, and fine elevations in columns of azimuth.
_AZIMUTHS = 8192  # fine azimuths, of 0.03 to 0.06 degrees; four quadrants
_PER_COLUMN = 8  # of them in a column
_LEVELS = 1920  # fine elevations
_PER_DEGREE = 16  # of them in a row
_GAPS = 1024  # bins of gaps, of a 16th of a degree of elevation, or a quarter of the narrowest bin of azimuth
_NEAREST = 10.0  # metres; nearer to the origin, the position of the sensor would matter
_FEWEST = 100  # gaps between directions; fewer do not tell the spacing
_SHARE = 1.5  # reach over spacing; beams are not evenly spaced, and some returns are lost
_FARTHEST = 6  # pixels, the largest reach


class Spacing(NamedTuple):
    """How far around a position a sweep must have a point, for each of B windows."""

    angle: Tensor  # (B,) float64, radians, between neighbouring beams of a ring
    rise: Tensor  # (B,) float64, between neighbouring rings, height over distance
    most: int  # pixels, the largest reach in any window
    has_tall: bool  # some pixel is tall

    @classmethod
    def of(cls, batch: Batch, grid: Grid, slice_height: float) -> Spacing:
        """Measure the spacing in sweep t+1 of each window.

        Convention:
            We divide the directions of the points, seen from the origin of the ego frame, into rows of one degree of
            elevation. The angle is the median of the gaps between the directions in a row. In the same way, the rise is
            measured in columns of azimuth. Both are 0 if there are few gaps.

        Cost: some passes over the points of t+1.
        """
        angle, rise = _median_gaps(batch)
        corner = max(math.hypot(x, y) for x in (grid.lower[0], grid.upper[0]) for y in (grid.lower[1], grid.upper[1]))
        largest_angle, largest_rise = torch.stack((angle, rise)).amax(1).tolist()
        most = int(_SHARE * corner / grid.pixel_size * largest_angle + 0.5)
        return cls(angle, rise, min(max(most, 1), _FARTHEST), corner * largest_rise >= slice_height)

    def reach(self, grid: Grid, window: Tensor, row_col: Tensor) -> Tensor:
        """Return the reach at K pixels, (K,) uint8.

        Args:
            window: (K,) int64.
            row_col: (2, K) int64, inside of the images or in a border.

        Convention: the reach is 1.5 times the spacing, rounded, from 1 to 6 pixels. The spacing is the distance of the
            middle of the pixel from the origin, times the angle.
        """
        reach = torch.ones_like(window, dtype=torch.uint8)
        for least in range(2, self.most + 1):
            reach += self.are_wide(grid, window, row_col, least)
        return reach

    def are_wide(self, grid: Grid, window: Tensor, row_col: Tensor, reach: int, margin: float = 0.0) -> Tensor:
        """Tell at which of K pixels the reach is at least `reach` pixels, or would be if they were `margin` farther."""
        return _are_beyond((reach - 0.5) / (_SHARE * self.angle) - margin, grid, window, row_col)

    def are_tall(self, grid: Grid, window: Tensor, row_col: Tensor, slice_height: float) -> Tensor:
        """Tell at which of K pixels rings are farther apart than a slice is high, (K,) bool."""
        return _are_beyond(slice_height / grid.pixel_size / self.rise, grid, window, row_col)


def _are_beyond(distance: Tensor, grid: Grid, window: Tensor, row_col: Tensor) -> Tensor:
    """Tell which of K pixels are farther from the origin than a distance, (K,) bool.

    `distance` is (B,) float64, pixels, to the middle of a pixel; it may be infinite.
    """
    middle = constant(tuple(lower / grid.pixel_size + 0.5 for lower in grid.lower[1::-1]), torch.float64, window.device)
    from_origin = row_col + middle[:, None]  # [2, K]
    return from_origin.square().sum(0) > distance.clamp(min=0).square().index_select(0, window)


def _median_gaps(batch: Batch) -> tuple[Tensor, Tensor]:
    """Return the medians of the gaps between neighbouring directions of t+1, across and up, (B,) float64 each."""
    x, y, _ = batch.positions[:, : batch.num_newest]
    far = flat_nonzero(x * x + y * y >= _NEAREST**2)
    x, y, z = take_columns(batch.positions, far).float()
    window = floor_divide(batch.image.index_select(0, far).long(), batch.num_steps)
    azimuth = azimuth_bin(x, y, _AZIMUTHS)
    level = elevation_bin(z, (x * x + y * y).sqrt_(), _LEVELS, _PER_DEGREE)
    rows = Lattice(_LEVELS // _PER_DEGREE, _AZIMUTHS)  # of a window
    columns = Lattice(_AZIMUTHS // _PER_COLUMN, _LEVELS)
    in_row = rows.cell(window, floor_divide(level, _PER_DEGREE), azimuth)
    in_column = columns.cell(window, floor_divide(azimuth, _PER_COLUMN), level)
    across = _median_gap(in_row, rows, batch.num_windows, _width_of_azimuth)
    up = _median_gap(in_column, columns, batch.num_windows, torch.ones_like)
    return across / _AZIMUTHS, divide(up, 57.3 * _PER_DEGREE)


def _median_gap(direction: Tensor, lines: Lattice, num_windows: int, width: Callable[[Tensor], Tensor]) -> Tensor:
    """Return the median of the gaps between neighbouring directions of a line, (B,) float64, bins of gaps; 0 = few.

    Args:
        direction: (K,) int64, cells of the lattice, which has an image for each window, and a row for each line.
        width: tells how wide the cells of a line are, in bins of gaps.
    """
    occupied = flat_nonzero(draw(direction, num_windows * lines.area))
    line, cell = split_index(occupied, lines.width)
    gap = (cell.diff() * width(cell[:-1])).long().clamp_(0, _GAPS - 1)
    window = floor_divide(line[:-1], lines.height)
    counts = Groups(window * _GAPS + gap, num_windows * _GAPS).sum((line.diff() == 0).long())
    below = counts.view(-1, _GAPS).cumsum(1)
    median = (2 * below < below[:, -1:]).sum(1)  # the first bin that reaches half
    return median.double() * (below[:, -1] >= _FEWEST)


def _width_of_azimuth(azimuth: Tensor) -> Tensor:
    """Return the widths of bins of azimuth, (K,) float64, in bins of gaps."""
    in_quadrant = (azimuth % (_AZIMUTHS // 4) + 0.5).double() / (_AZIMUTHS // 4)
    return 4 / (in_quadrant.square() + (1 - in_quadrant).square())
