"""The spacing of points: how far apart the beams of a sweep hit a surface, which grows with the distance.

A sparse sensor hits a static surface at other positions in every sweep. So a slice is missing at a position only if no
point is within the spacing there. Where the spacing is less than a pixel, that is the 3 x 3 pixels around.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import draw, exceeds, flat_nonzero, floor_divide, scatter_count, split_index, take_columns
from cflow_torch.verified.directions import azimuth_bin, elevation_bin
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch

_AZIMUTHS = 8192  # bins of 0.04 to 0.09 degrees; four quadrants
_ELEVATIONS = 120  # bins of about one degree
_ANGLES = 1024  # bins of angle of 0.007 degrees
_PER_AZIMUTH = 4  # of them are as wide as the narrowest bin of azimuth
_NEAREST = 10.0  # metres; nearer to the origin, the position of the sensor would matter
_FEWEST = 100  # gaps between directions; fewer do not tell the spacing
_SHARE = 1.5  # reach over spacing; beams are not evenly spaced, and some returns are lost
_FARTHEST = 6  # pixels, the largest reach


class Spacing(NamedTuple):
    """How far around a position a sweep must have a point, for each of B windows."""

    angle: Tensor  # (B,) float64, radians, between neighbouring beams of a ring
    most: int  # pixels, the largest reach in any window

    @classmethod
    def of(cls, batch: Batch, grid: Grid) -> Spacing:
        """Measure the spacing in sweep t+1 of each window.

        Convention:
            We divide the directions of the points into rows of one degree of elevation, above the origin of the ego
            frame. The angle is the median of the gaps between the directions in a row, and 0 if there are few gaps.

        Cost: some passes over the points of t+1.
        """
        angle = _median_gap(batch)
        corner = max(math.hypot(x, y) for x in (grid.lower[0], grid.upper[0]) for y in (grid.lower[1], grid.upper[1]))
        most = int(_SHARE * corner / grid.pixel_size * float(angle.max()) + 0.5)
        return cls(angle, min(max(most, 1), _FARTHEST))

    def are_wide(self, grid: Grid, border: int, reach: int) -> Tensor:
        """Tell at which pixels the reach is at least `reach` pixels, (B, height, width) bool, with a border.

        Convention: the reach is 1.5 times the spacing, rounded, from 1 to 6 pixels. The spacing is the distance of the
            middle of the pixel from the origin, times the angle.
        """
        device = self.angle.device
        row = torch.arange(-border, grid.height + border, device=device) + (grid.lower[1] / grid.pixel_size + 0.5)
        col = torch.arange(-border, grid.width + border, device=device) + (grid.lower[0] / grid.pixel_size + 0.5)
        least = (reach - 0.5) / (_SHARE * self.angle[:, None])  # [B, 1], pixels, infinite if the angle is 0
        # From row to row, a pixel is wide if its column is farther than this from the middle.
        beyond = (least.square() - row.double().square()).clamp_(min=0).sqrt_()
        return exceeds(col.abs(), beyond.float()[..., None])


def _median_gap(batch: Batch) -> Tensor:
    """Return the median of the angles between neighbouring directions of t+1, (B,) float64, radians."""
    x, y, _ = batch.positions[:, : batch.num_newest]
    far = flat_nonzero(x * x + y * y >= _NEAREST**2)
    x, y, z = take_columns(batch.positions, far).float()
    distance = (x * x + y * y).sqrt_()
    window = floor_divide(batch.image.index_select(0, far).long(), batch.num_steps)
    row = window * _ELEVATIONS + elevation_bin(z, distance, _ELEVATIONS)
    direction = row * _AZIMUTHS + azimuth_bin(x, y, _AZIMUTHS)
    direction = flat_nonzero(draw(direction, batch.num_windows * _ELEVATIONS * _AZIMUTHS))
    row, azimuth = split_index(direction, _AZIMUTHS)
    in_quadrant = (azimuth[:-1] % (_AZIMUTHS // 4) + 0.5).double() / (_AZIMUTHS // 4)
    width = _PER_AZIMUTH / (in_quadrant.square() + (1 - in_quadrant).square())  # of the bin of azimuth
    angle = (direction.diff() * width).long().clamp_(max=_ANGLES - 1)
    angle += floor_divide(row[:-1], _ELEVATIONS) * _ANGLES
    is_gap = (row[1:] == row[:-1]).long()
    below = scatter_count(angle, batch.num_windows * _ANGLES, is_gap).view(-1, _ANGLES).cumsum(1)
    median = (2 * below < below[:, -1:]).sum(1)  # the first bin that reaches half
    return median.double() * (below[:, -1] >= _FEWEST) * (4 / _AZIMUTHS / _PER_AZIMUTH)
