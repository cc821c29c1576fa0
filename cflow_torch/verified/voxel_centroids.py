"""Voxels (pixels by height slices of every sweep), the centroids of their points, and the nearest one to a place."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, SLICE_HEIGHT, HeightSlicedSweeps, slice_of

# Centroids are whole numbers of 1 / UNITS metre: their sums are exact, in any order of the points and on any device.
UNITS = 1024
_BEYOND = 2.0**28  # units: a place far beyond every other


@dataclass(frozen=True)
class ObjectPoints:
    """N points of G objects, of all sweeps; the points of a pixel have one object.

    Args:
        owner: (N,) int64, object of each.
        window, step: (N,) int64, which sweep: step 0 = t+1, 1 = t, ...
        pixel: (N,) int64, number of its occupied pixel, 0 ... P - 1.
        part: (N,) int64, height slice, 0 ... 3 (or as many as `points_of_objects` was asked for).
        position: (2, N) float64, x and y, metres, frame of t+1; inside the region.
        time: (N,) float32, sweep intervals, `Batch.point_times`; None = there are none.
    """

    owner: Tensor
    window: Tensor
    step: Tensor
    pixel: Tensor
    part: Tensor
    position: Tensor
    time: Optional[Tensor] = None

    def take(self, wanted: Tensor) -> ObjectPoints:
        """Some of them, (N,) bool."""
        return self.at(flat_nonzero(wanted))

    def at(self, index: Tensor) -> ObjectPoints:
        """Some of them, (K,) int64."""
        owner, window, step, pixel, part = (
            values.index_select(0, index) for values in (self.owner, self.window, self.step, self.pixel, self.part)
        )
        time = None if self.time is None else self.time.index_select(0, index)
        return ObjectPoints(owner, window, step, pixel, part, self.position.index_select(1, index), time)


def points_of_objects(
    sweeps: HeightSlicedSweeps,
    objects: Objects,
    wanted: Tensor,
    slice_height: float = SLICE_HEIGHT,
    num_slices: int = NUM_SLICES,
) -> ObjectPoints:
    """The points of some objects in all sweeps, in the order of the batch.

    Args:
        sweeps: finest images.
        objects: G of them.
        wanted: (G,) bool.
        slice_height: metres.
        num_slices: a power of 2.

    Cost: two look-ups a point, the rest for those that are kept.
    """
    of_pixel = F.pad(objects.pixels_of(wanted), (0, 1), value=objects.count)
    pixel = sweeps.number.index_select(0, sweeps.place)
    rows = flat_nonzero((of_pixel < objects.count).index_select(0, pixel))
    pixel = pixel.index_select(0, rows).long()
    x, y, z = sweeps.batch.positions.index_select(1, rows).unbind(0)
    window, step = split_index(sweeps.batch.image.index_select(0, rows).long(), sweeps.num_steps)
    part = slice_of(z, slice_height, num_slices).long()
    times = sweeps.batch.point_times
    time = None if times is None else times.index_select(0, rows)
    return ObjectPoints(of_pixel.index_select(0, pixel), window, step, pixel, part, torch.stack((x, y)), time)


class Voxels:
    """V voxels that hold points of objects, by pixel, then by slice.

    Args:
        points: of all sweeps.
        sweeps: finest images.
        num_slices: of the points.

    Attributes:
        owner, window, step, part: (V,) int64, as for `ObjectPoints`.
        x, y: (V + 1,) float64, centroid, whole units of 1/1024 m from the lower corner of the region; the last entry,
            of no voxel, is far away.
        time: (V,) float64, mean of `ObjectPoints.time`; None = there are none.

    Convention: a coordinate is rounded to the nearest unit, their mean down to a whole one.

    Cost: a sort of the points.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_slices: int = NUM_SLICES) -> None:
        self._sweeps, self._num_slices = sweeps, num_slices
        key, voxel, count = torch.unique(
            points.pixel * num_slices + points.part, return_inverse=True, return_counts=True
        )
        self.x, self.y = (
            self._centroids(values - lower, voxel, count)
            for values, lower in zip(points.position.unbind(0), sweeps.grid.lower)
        )
        num_keys = num_slices * (sweeps.pixel.numel() + 1)
        self._of_key = torch.full((num_keys,), key.numel(), dtype=torch.int64, device=key.device)
        self._of_key.scatter_(0, key, torch.arange(key.numel(), device=key.device))
        # Of all points of a voxel these are the same, so it does not matter which of them is written last.
        self.owner, self.window, self.step = (
            torch.zeros_like(key).scatter_(0, voxel, values) for values in (points.owner, points.window, points.step)
        )
        self.part = key & (num_slices - 1)
        self.time: Optional[Tensor] = None
        if points.time is not None:
            self.time = torch.zeros_like(count, dtype=torch.float64).index_add_(0, voxel, points.time.double()) / count

    @staticmethod
    def _centroids(values: Tensor, voxel: Tensor, count: Tensor) -> Tensor:
        """(V + 1,) mean, in units, of the (N,) coordinates in each voxel."""
        sums = torch.zeros_like(count, dtype=values.dtype).index_add_(0, voxel, whole(values * UNITS))
        return F.pad(torch.floor(sums / count), (0, 1), value=_BEYOND)

    def nearest(self, window: Tensor, step: Tensor, part: Tensor, x: Tensor, y: Tensor) -> Tensor:
        """Nearest voxel of a sweep, in the 3 x 3 pixels around a place and in the slice given.

        Args:
            window, step, part: (K,) int64.
            x, y: (K,) float64, units from the lower corner, anywhere.

        Returns:
            (K,) int64, V = there is none.

        Cost: nine look-ups each.
        """
        voxel = self.around(window, step, part, x, y, 1)
        dx = self.x.index_select(0, voxel.view(-1)).view_as(voxel).sub_(x)
        dy = self.y.index_select(0, voxel.view(-1)).view_as(voxel).sub_(y)
        # The square and the place in one number: its least is found several times faster than by argmin.
        key = dx.mul_(dx).add_(dy.mul_(dy)).long().mul_(16).add_(torch.arange(9, device=x.device)[:, None])
        return voxel.gather(0, key.amin(0, keepdim=True).bitwise_and_(15))[0]

    def around(self, window: Tensor, step: Tensor, part: Tensor, x: Tensor, y: Tensor, reach: int) -> Tensor:
        """Voxels of a sweep in the pixels around a place, `reach` pixels each way, and in the slice given.

        Args:
            window, step, part, x, y: as for `nearest`.
            reach: r, pixels.

        Returns:
            ((2 r + 1)^2, K) int64, in raster order, V = there is none.
        """
        grid = self._sweeps.grid
        size = torch.full((), grid.pixel_size * UNITS, dtype=torch.float64, device=x.device)
        offset = torch.arange(-reach, reach + 1, device=x.device)[:, None]
        row = torch.floor(y / size).long() + offset
        col = torch.floor(x / size).long() + offset
        line = ((window * self._sweeps.num_steps + step) * grid.height + row) * grid.width
        is_row, is_col = (row >= 0) & (row < grid.height), (col >= 0) & (col < grid.width)
        place = (line[:, None] + col).flatten(0, 1)
        inside = (is_row[:, None] & is_col).view_as(place)
        place.masked_fill_(~inside, self._sweeps.image.numel() - 1)
        pixel = self._sweeps.number_at(place.view(-1)).view_as(place)
        return self._of_key.index_select(0, pixel.mul_(self._num_slices).add_(part).view(-1)).view_as(place)


def whole(x: Tensor) -> Tensor:
    """Nearest whole number, halves up."""
    return torch.floor(x + 0.5)


def meeting_weights(sigma: float, device: torch.device) -> Tensor:
    """(2049,) float64 whole numbers: weights exp(-d^2 / 2 sigma^2) of centroids that miss each other by d, in 256ths.

    Args:
        sigma: metres.
        device: where it is to lie.

    Convention: entry i stands for d^2 from 64 i to 64 (i + 1) square units; the last one, 0, for all that is farther.
    """
    square = 64 * torch.arange(2048, dtype=torch.float64) + 32
    return F.pad(whole(256 * torch.exp(square / (-2 * (sigma * UNITS) ** 2))), (0, 1)).to(device)
