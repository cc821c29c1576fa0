"""Voxels: pixels by height slices of every sweep, the centroids of their points, and the nearest one to a place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.cells import NUM_SLICES
from cflow_torch.grid import Grid
from cflow_torch.moving import MovingPoints

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
        of_key: (4 P + 4,) int64, voxel of pixel * 4 + part, V = none.
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
        device = x.device
        side = torch.full((), self.grid.pixel_size * UNITS, dtype=torch.float64, device=device)
        offset = torch.arange(-1, 2, device=device)[:, None]
        row = (torch.floor(y.double() / side).long() + offset).repeat_interleave(3, 0)  # (9, K)
        col = (torch.floor(x.double() / side).long() + offset).repeat(3, 1)
        inside = (row >= 0) & (row < self.grid.height) & (col >= 0) & (col < self.grid.width)
        place = ((window * self.num_steps + step) * self.grid.height + row) * self.grid.width + col
        place = torch.where(inside, place, self.pixel_of_place.numel() - 1)
        pixel = self.pixel_of_place.index_select(0, place.view(-1)).view_as(place)
        voxel = self.of_key.index_select(0, (pixel * NUM_SLICES + part).view(-1))
        dx = self.x.index_select(0, voxel).view_as(place).sub_(x)
        dy = self.y.index_select(0, voxel).view_as(place).sub_(y)
        distance = dx.mul_(dx).add_(dy.mul_(dy))
        # No two keys of a column are equal.
        key = distance.mul_(16).add_(torch.arange(9, device=device)[:, None]).amin(0, keepdim=True)
        return voxel.view_as(place).gather(0, key & 15)[0]


def make_voxels(points: MovingPoints, pixel_of_place: Tensor, num_pixels: int, grid: Grid, num_steps: int) -> Voxels:
    """Voxels that hold points, and the centroids of what they hold.

    Args:
        points: of all sweeps.
        pixel_of_place: (Q,) int32 or int64, number of the occupied pixel at each place, P = none; the last entry, P,
            is for what lies outside of the images.
        num_pixels: P.
        grid: whose pixels these are.
        num_steps: S.

    Convention: a coordinate is rounded to the nearest unit, their mean down to a whole one.

    Cost: a sort of the points.
    """
    device = points.part.device
    key, voxel, count = torch.unique(points.pixel * NUM_SLICES + points.part, return_inverse=True, return_counts=True)
    x, y = (_centroid(values, lower, voxel, count) for values, lower in zip(points.position.unbind(0), grid.lower))
    of_key = torch.full((NUM_SLICES * (num_pixels + 1),), key.numel(), dtype=torch.int64, device=device)
    of_key.scatter_(0, key, torch.arange(key.numel(), device=device))
    # Of all points of a voxel these are the same, so it does not matter which of them is written last.
    group, window, step = (
        torch.zeros_like(key).scatter_(0, voxel, of_point) for of_point in (points.group, points.window, points.step)
    )
    part = key & (NUM_SLICES - 1)
    return Voxels(grid, num_steps, group, window, step, part, x, y, of_key, pixel_of_place)


def _centroid(values: Tensor, lower: float, voxel: Tensor, count: Tensor) -> Tensor:
    """(V + 1,) int64 mean, in units, of the (N,) coordinates in each voxel; the last entry is far away."""
    units = torch.floor((values - lower) * UNITS + 0.5).long()
    mean = torch.div(torch.zeros_like(count).index_add_(0, voxel, units), count, rounding_mode="floor")
    return F.pad(mean, (0, 1), value=_FAR)
