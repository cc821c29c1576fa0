"""Voxels (pixels by height slices of every sweep), the centroids of their points, and the nearest one to a place."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero, gather, lookup, scatter_count
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import NUM_SLICES, SLICE_HEIGHT, HeightSlicedSweeps, slice_of

# Centroids are whole numbers of 1 / UNITS metre: their sums are exact, in any order of the points and on any device.
UNITS = 1024
_BEYOND = 2.0**28  # units: a place far beyond every other
_FARTHEST = 2.0**48  # square units: no square between voxels of a region is as large


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
    time: Tensor | None = None

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
    slice_height: float | Tensor = SLICE_HEIGHT,
    num_slices: int = NUM_SLICES,
) -> ObjectPoints:
    """The points of some objects in all sweeps, in the order of the batch.

    Args:
        sweeps: finest images.
        objects: G of them.
        wanted: (G,) bool.
        slice_height: metres; one for all, or (G,) float64.
        num_slices: a power of 2.

    Cost: two look-ups a point, the rest for those that are kept.
    """
    points = flat_nonzero(lookup(lookup(wanted, objects.of_pixel), sweeps.pixel_of_point))
    pixel, rows = sweeps.pixel_of_point.index_select(0, points), sweeps.point(points)
    x, y, z = sweeps.batch.positions.index_select(1, rows).unbind(0)
    window, step, owner = gather(pixel, sweeps.pixels.window, sweeps.pixels.step, objects.of_pixel)
    if isinstance(slice_height, Tensor):
        slice_height = slice_height.index_select(0, owner)
    part = slice_of(z, slice_height, num_slices).long()
    times = sweeps.batch.point_times
    time = None if times is None else times.index_select(0, rows)
    return ObjectPoints(owner, window, step, pixel, part, torch.stack((x, y)), time)


class Voxels:
    """V voxels that hold points of objects, by pixel, then by slice.

    Args:
        points: of all sweeps.
        sweeps: finest images.
        num_slices: of the points.

    Attributes:
        owner, window, step, part: (V,) int64, as for `ObjectPoints`.
        place: (2, V + 1) float64, x and y of the centroid, whole units of 1/1024 m from the lower corner of the region;
            the last entry, of no voxel, is far away.
        time: (V,) float64, mean of `ObjectPoints.time`; None = there are none.

    Convention: a coordinate is rounded to the nearest unit, their mean down to a whole one.

    Cost: a sort of the points.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_slices: int = NUM_SLICES) -> None:
        self._sweeps, self._num_slices, self.num_steps = sweeps, num_slices, sweeps.num_steps
        key, voxel, count = torch.unique(
            points.pixel * num_slices + points.part, return_inverse=True, return_counts=True
        )
        corner = torch.tensor(sweeps.grid.lower[:2], dtype=torch.float64, device=key.device)[:, None]
        sums = scatter_count(voxel, key.numel(), whole((points.position - corner) * UNITS))
        self.place = F.pad(torch.floor(sums / count), (0, 1), value=_BEYOND)
        # The first pixel of the table is "none", as in `HeightSlicedSweeps.rank`.
        self._of_key = torch.full((num_slices * (sweeps.num_pixels + 1),), key.numel(), device=key.device)
        self._of_key.scatter_(0, key + num_slices, torch.arange(key.numel(), device=key.device))
        # Of all points of a voxel these are the same, so it does not matter which of them is written last.
        first = torch.zeros_like(key).scatter_(0, voxel, torch.arange(len(voxel), device=key.device))
        self.owner, self.window, self.step = gather(first, points.owner, points.window, points.step)
        self.part = key & (num_slices - 1)
        self.time: Tensor | None = None
        if points.time is not None:
            self.time = torch.zeros_like(count, dtype=torch.float64).index_add_(0, voxel, points.time.double()) / count

    def nearest(self, sweep: Tensor, part: Tensor, place: Tensor) -> Tensor:
        """Nearest voxel of a sweep, in the 3 x 3 pixels around a place and in the slice given.

        Args:
            sweep: (K,) int64, window * S + step.
            part: (K,) int64.
            place: (2, K) float64, x and y, units from the lower corner, anywhere.

        Returns:
            (K,) int64, V = there is none.

        Cost: nine look-ups each.
        """
        voxel = self.around(sweep, part, place, 1)
        square = self.place.index_select(1, voxel.view(-1)).view(2, *voxel.shape).sub_(place[:, None]).square_().sum(0)
        # The square and the place in one number: its least is found several times faster than by argmin. In float64,
        # which holds these numbers exactly, many times faster than in int64.
        slot = torch.arange(9, dtype=torch.float64, device=place.device)[:, None]
        key = torch.add(slot, square.clamp_(max=_FARTHEST), alpha=16)
        return voxel.gather(0, key.amin(0, keepdim=True).long().bitwise_and_(15))[0]

    def around(self, sweep: Tensor, part: Tensor, place: Tensor, reach: int) -> Tensor:
        """Voxels of a sweep in the pixels around a place, `reach` pixels each way, and in the slice given.

        Args:
            sweep, part, place: as for `nearest`.
            reach: r, pixels.

        Returns:
            ((2 r + 1)^2, K) int64, in raster order, V = there is none, also where one of the pixels lies outside.
        """
        grid, line = self._sweeps.grid, torch.arange(-reach, reach + 1, device=part.device)
        size = torch.full((), grid.pixel_size * UNITS, dtype=torch.float64, device=part.device)
        last = torch.tensor(((grid.width - 1 - reach,), (grid.height - 1 - reach,)), device=part.device)
        at = torch.floor(place / size).long()
        inside = ((at >= reach) & (at <= last)).all(0)
        pixel = sweep * (grid.height * grid.width) + at[1] * grid.width + at[0]
        pixel = pixel + (line[:, None] * grid.width + line).view(-1, 1)
        pixel = torch.where(inside, pixel, self._sweeps.image.numel() - 1)
        rank = self._sweeps.rank.index_select(0, pixel.view(-1)).view_as(pixel)
        return self._of_key.index_select(0, torch.add(part, rank, alpha=self._num_slices).view(-1)).view_as(pixel)


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
