"""Voxels (pixels by height slices of every sweep), the centroids of their points, and the nearest one to a position."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import constant, flat_nonzero, gather, lookup, scatter_count
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, slice_of

# Centroids are whole numbers of 1 / UNITS metre: their sums are exact, in any order of the points and on any device.
UNITS = 1024
_HIGHEST = 2.0**24  # units: coordinates are clamped to this, which is far beyond a region, so that no square overflows
_BEYOND = 2.0**28  # units: a position far beyond every other
_FARTHEST = 2.0**46  # square units: no square between voxels of a region is as large


@dataclass(frozen=True)
class ObjectPoints:
    """N points of G objects, of all sweeps; the points of a pixel have one object.

    Args:
        object_id: (N,) int64, object of each.
        window, step: (N,) int64, which sweep: step 0 = t+1, 1 = t, ...
        pixel: (N,) int64, number of its occupied pixel, 0 ... P - 1.
        layer: (N,) int64, height slice, from 0 on.
        position: (3, N) float64, metres, frame of t+1; inside the region.
        time: (N,) float32, sweep intervals, `Batch.point_times`; None = there are none.
    """

    object_id: Tensor
    window: Tensor
    step: Tensor
    pixel: Tensor
    layer: Tensor
    position: Tensor
    time: Tensor | None = None

    def take(self, wanted: Tensor) -> ObjectPoints:
        """Some of them, (N,) bool."""
        return self.at(flat_nonzero(wanted))

    def at(self, index: Tensor) -> ObjectPoints:
        """Some of them, (K,) int64."""
        object_id, window, step, pixel, layer = (
            values.index_select(0, index) for values in (self.object_id, self.window, self.step, self.pixel, self.layer)
        )
        time = None if self.time is None else self.time.index_select(0, index)
        return ObjectPoints(object_id, window, step, pixel, layer, self.position.index_select(1, index), time)


def points_of_objects(
    sweeps: HeightSlicedSweeps,
    objects: Objects,
    wanted: Tensor,
    slice_height: float,
    num_slices: int,
) -> ObjectPoints:
    """The points of some objects in all sweeps, in the order of the batch.

    Args:
        sweeps: finest images.
        objects: G of them.
        wanted: (G,) bool.
        slice_height: metres.
        num_slices: a power of 2.

    Cost: two lookups a point, the rest for those that are kept.
    """
    points = flat_nonzero(lookup(lookup(wanted, objects.of_pixel), sweeps.pixel_of_point))
    pixel, rows = sweeps.pixel_of_point.index_select(0, points), sweeps.point(points)
    position = sweeps.batch.positions.index_select(1, rows)
    window, step, object_id = gather(pixel, sweeps.pixels.window, sweeps.pixels.step, objects.of_pixel)
    layer = slice_of(position[2], slice_height, num_slices).long()
    times = sweeps.batch.point_times
    time = None if times is None else times.index_select(0, rows)
    return ObjectPoints(object_id, window, step, pixel, layer, position, time)


class Voxels:
    """V voxels that hold points of objects, by pixel, then by slice.

    Args:
        points: of all sweeps.
        sweeps: finest images.
        num_slices: of the points.

    Attributes:
        object_id, window, step, layer: (V,) int64, as for `ObjectPoints`.
        position: (V + 1,) complex128, x + iy of the centroid, whole units of 1/1024 m from the lower corner of the
            region; the last entry, of no voxel, is far away.
        height: (V + 1,) float64, z of the centroid, whole units from 0.
        time: (V,) float64, mean of `ObjectPoints.time`; None = there are none.

    Convention: a coordinate is rounded to the nearest unit, their mean down to a whole one.

    Cost: a sort of the points.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_slices: int) -> None:
        self._sweeps, self._num_slices, self.num_steps = sweeps, num_slices, sweeps.num_steps
        key, voxel, count = torch.unique(
            points.pixel * num_slices + points.layer, return_inverse=True, return_counts=True
        )
        corner = torch.tensor((*sweeps.grid.lower[:2], 0.0), dtype=torch.float64, device=key.device)[:, None]
        position = whole((points.position - corner) * UNITS).clamp_(-_HIGHEST, _HIGHEST)
        sums = scatter_count(voxel, key.numel(), position)
        x, y, self.height = F.pad(torch.floor(sums / count), (0, 1), value=_BEYOND)
        self.position = torch.complex(x, y)
        # The first pixel of the table is "none", as in `HeightSlicedSweeps.rank`.
        self._of_key = torch.full((num_slices * (sweeps.num_pixels + 1),), key.numel(), device=key.device)
        self._of_key.scatter_(0, key + num_slices, torch.arange(key.numel(), device=key.device))
        # Of all points of a voxel these are the same, so it does not matter which of them is written last.
        first = torch.zeros_like(key).scatter_(0, voxel, torch.arange(len(voxel), device=key.device))
        self.object_id, self.window, self.step = gather(first, points.object_id, points.window, points.step)
        self.layer = key & (num_slices - 1)
        self.time: Tensor | None = None
        if points.time is not None:
            self.time = torch.zeros_like(count, dtype=torch.float64).index_add_(0, voxel, points.time.double()) / count

    def nearest(self, sweep: Tensor, layer: Tensor, position: Tensor, height: Tensor) -> Tensor:
        """Nearest voxel of a sweep, in the 3 x 3 pixels around a position, in the slice given and in those next to it.

        Args:
            sweep: (K,) int64, window * S + step.
            layer: (K,) int64.
            position: (K,) complex128, x + iy, units from the lower corner, anywhere.
            height: (K,) float64, units.

        Returns:
            (K,) int64, V = there is none. Ties: the lowest slice of the first pixel in raster order; the highest slice
            is below the first.

        Cost: 27 lookups each.
        """
        voxel = self.around(sweep, layer, position, 1, 1)
        apart = self.position.index_select(0, voxel.view(-1)).view_as(voxel).sub_(position)
        square = torch.view_as_real(apart).square_().sum(-1)
        square += (self.height.index_select(0, voxel.view(-1)).view_as(voxel) - height).square_()
        # The square and the slot in one number: its least is found several times faster than by argmin. In float64,
        # which holds these numbers exactly, many times faster than in int64.
        slot = torch.arange(len(voxel), dtype=torch.float64, device=position.device)[:, None]
        key = torch.add(slot, square.clamp_(max=_FARTHEST), alpha=32)
        return voxel.gather(0, key.amin(0, keepdim=True).long().bitwise_and_(31))[0]

    def around(self, sweep: Tensor, layer: Tensor, position: Tensor, reach: int, layers: int = 0) -> Tensor:
        """Voxels of a sweep in the pixels around a position, `reach` pixels each way, and in the slice given.

        Args:
            sweep, layer, position: as for `nearest`.
            reach: r, pixels.
            layers: l, slices below and above.

        Returns:
            ((2 r + 1)^2 (2 l + 1), K) int64, pixel by pixel in raster order, V = there is none. Near the border and
            beyond it, the pixels are the outermost ones.
        """
        grid = self._sweeps.grid
        ends = ((reach, reach), (grid.width - 1 - reach, grid.height - 1 - reach))
        size = constant((grid.pixel_size * UNITS,), torch.float64, layer.device)
        at = torch.floor(torch.view_as_real(position) / size).clamp_(*constant(ends, torch.int64, layer.device)).long()
        pixel = torch.add(at[:, 0], at[:, 1], alpha=grid.width).add_(sweep, alpha=grid.height * grid.width)
        line = torch.arange(-reach, reach + 1, device=layer.device)
        pixel = pixel + torch.add(line, line[:, None], alpha=grid.width).view(-1, 1)
        pixel.clamp_(0, self._sweeps.rank.numel() - 1)  # a tiny image has fewer rows or columns than are asked for
        rank = self._sweeps.rank.index_select(0, pixel.view(-1)).view(len(pixel), 1, -1)
        near = torch.arange(-layers, layers + 1, device=layer.device)[:, None]
        key = torch.add((layer + near) & (self._num_slices - 1), rank, alpha=self._num_slices).view(-1)
        return self._of_key.index_select(0, key).view(len(pixel) * len(near), -1)


def whole(x: Tensor) -> Tensor:
    """Nearest whole number, halves up; of a complex number, that of both parts."""
    if x.is_complex():
        return torch.view_as_complex(whole(torch.view_as_real(x)))
    return torch.floor(x + 0.5)
