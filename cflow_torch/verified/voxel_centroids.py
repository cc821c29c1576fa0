"""Voxels: pixels by height slices of every sweep, the centroids of their points, and the nearest one to a place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.verified.height_slices import NUM_SLICES
from cflow_torch.verified.moving import MovingPoints
from cflow_torch.windows.bev_grid import Grid

# Centroids are whole numbers of 1 / UNITS metre from the lower corner of the region: their sums have no order.
UNITS = 1024
# A place far beyond every other; 32 times its square fits in 62 bits.
_FAR = 1 << 28


@dataclass(frozen=True)
class Voxels:
    """V voxels, by pixel, then by slice.

    Args:
        grid: its pixels.
        num_steps: S, sweeps of a window.
        group, window, step, part: (V,) int64, as for `MovingPoints`.
        x, y: (V + 1,) int64, centroid, units from the lower corner; the last entry, of no voxel, is far away.
        num_slices: n, a power of 2.
        of_key: (n P + n,) int64, voxel of pixel * n + part, V = none.
        pixel_of_place: (Q,) int32 or int64, number of the occupied pixel at each place of the images, P = none.
    """

    grid: Grid
    num_steps: int
    group: Tensor
    window: Tensor
    step: Tensor
    part: Tensor
    x: Tensor
    y: Tensor
    num_slices: int
    of_key: Tensor
    pixel_of_place: Tensor

    def nearest(self, window: Tensor, step: Tensor, part: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Nearest voxel of a sweep, in the 3 x 3 pixels around a place and in the slice given.

        Args:
            window, step, part: (K,) int64.
            x, y: (K,) int64, units from the lower corner, anywhere.

        Returns:
            (K,) int64, V = there is none.

        Convention: of equally near ones the first in raster order.

        Cost: nine look-ups each.
        """
        voxel = self.around(window, step, part, x, y, 1)
        dx = self.x.index_select(0, voxel.view(-1)).view_as(voxel).sub_(x)
        dy = self.y.index_select(0, voxel.view(-1)).view_as(voxel).sub_(y)
        distance = dx.mul_(dx).add_(dy.mul_(dy))
        # No two keys of a column are equal.
        key = distance.mul_(16).add_(torch.arange(9, device=x.device)[:, None]).amin(0, keepdim=True)
        return voxel.gather(0, key & 15)[0]

    def around(self, window: Tensor, step: Tensor, part: Tensor, x: Tensor, y: Tensor, reach: int) -> Tensor:
        """Voxels of a sweep in the pixels around a place, `reach` pixels each way, and in the slice given.

        Args:
            window, step, part, x, y: as for `nearest`.
            reach: r, pixels.

        Returns:
            ((2 r + 1)^2, K) int64, in raster order, V = there is none.
        """
        side = torch.full((), self.grid.pixel_size * UNITS, dtype=torch.float64, device=x.device)
        offset = torch.arange(-reach, reach + 1, device=x.device)[:, None]
        row, col = torch.floor(y.double() / side).long() + offset, torch.floor(x.double() / side).long() + offset
        line = ((window * self.num_steps + step) * self.grid.height + row) * self.grid.width
        is_row, is_col = (row >= 0) & (row < self.grid.height), (col >= 0) & (col < self.grid.width)
        place = (line[:, None] + col).flatten(0, 1)
        inside = (is_row[:, None] & is_col).view_as(place)
        place.masked_fill_(~inside, self.pixel_of_place.numel() - 1)
        pixel = self.pixel_of_place.index_select(0, place.view(-1)).view_as(place).long()
        return self.of_key.index_select(0, pixel.mul_(self.num_slices).add_(part).view(-1)).view_as(place)


def make_voxels(
    points: MovingPoints,
    pixel_of_place: Tensor,
    num_pixels: int,
    grid: Grid,
    num_steps: int,
    num_slices: int = NUM_SLICES,
) -> Voxels:
    """Voxels that hold points, and the centroids of what they hold.

    Args:
        points: of all sweeps.
        pixel_of_place: (Q,) int32 or int64, number of the occupied pixel at each place, P = none; the last entry, P,
            is for what lies outside of the images.
        num_pixels: P.
        grid: whose pixels these are.
        num_steps: S.
        num_slices: of the points, a power of 2.

    Convention: a coordinate is rounded to the nearest unit, their mean down to a whole one.

    Cost: a sort of the points.
    """
    device = points.part.device
    key, voxel, count = torch.unique(points.pixel * num_slices + points.part, return_inverse=True, return_counts=True)
    x, y = (_centroid(values, lower, voxel, count) for values, lower in zip(points.position.unbind(0), grid.lower))
    of_key = torch.full((num_slices * (num_pixels + 1),), key.numel(), dtype=torch.int64, device=device)
    of_key.scatter_(0, key, torch.arange(key.numel(), device=device))
    # Of all points of a voxel these are the same, so it does not matter which of them is written last.
    group, window, step = (
        torch.zeros_like(key).scatter_(0, voxel, of_point) for of_point in (points.group, points.window, points.step)
    )
    part = key & (num_slices - 1)
    return Voxels(grid, num_steps, group, window, step, part, x, y, num_slices, of_key, pixel_of_place)


def _centroid(values: Tensor, lower: float, voxel: Tensor, count: Tensor) -> Tensor:
    """(V + 1,) int64 mean, in units, of the (N,) coordinates in each voxel; the last entry is far away."""
    units = torch.floor((values - lower) * UNITS + 0.5).long()
    mean = torch.div(torch.zeros_like(count).index_add_(0, voxel, units), count, rounding_mode="floor")
    return F.pad(mean, (0, 1), value=_FAR)
