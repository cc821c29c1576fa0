"""Voxels of objects: their centroids, the search for the nearest voxel, and the spread of the surface around each.

A voxel is a pixel and a height slice of a sweep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import constant, flat_nonzero, gather, lookup, scatter_count, split_index, take_columns
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, slice_of

# Centroids are multiples of 1 / UNITS metre, so their sums are exact, in any order of the points and on any device.
UNITS = 1024
NOISE = 0.05  # metres, standard deviation of a centroid, besides the spread of its surface
_SIDE = 2  # side of a block, voxels. A block and the blocks around it cover 0.6 m
_STEP = 4  # units; spreads use coordinates in multiples of 1/256 m, so that sums are exact
_ROW, _LAYER = 1 << 15, 1 << 12  # more than the blocks in a row or column; more than the blocks in a stack
# The two factors of each moment, among 1, x, y and z. Then: the moments in the 3 x 3 matrix of squares, row by row.
_FACTORS = ((0, 0, 0, 0, 1, 1, 1, 2, 2, 3), (0, 1, 2, 3, 1, 2, 3, 2, 3, 3))
_SQUARES = (4, 5, 6, 5, 7, 8, 6, 8, 9)


@dataclass(frozen=True)
class ObjectPoints:
    """N points of G objects, of all sweeps; all points of a pixel belong to one object."""

    object_id: Tensor  # (N,) int64, object of each point
    pixel: Tensor  # (N,) int64, position of the pixel of each point in the list of occupied pixels
    layer: Tensor  # (N,) int64, height slice of each point, from 0 on
    position: Tensor  # (3, N) float64, metres, frame of t+1; inside the region
    time: Tensor | None = None  # (N,) float32, sweep intervals, `Batch.point_times`; None = no times are given

    def at(self, index: Tensor) -> ObjectPoints:
        """Select points by their positions in the list, (K,) int64."""
        object_id, pixel, layer = gather(index, self.object_id, self.pixel, self.layer)
        time = None if self.time is None else self.time.index_select(0, index)
        return ObjectPoints(object_id, pixel, layer, take_columns(self.position, index), time)


def points_of_objects(
    sweeps: HeightSlicedSweeps,
    objects: Objects,
    wanted: Tensor,
    slice_height: float,
    num_slices: int,
    most_time: float = math.inf,
) -> ObjectPoints:
    """Return the points of some objects, in the order of the batch.

    Args:
        wanted: (G,) bool.
        slice_height: metres, height of a layer.
        num_slices: number of layers before they repeat, a power of 2.
        most_time: sweep intervals; sweeps farther in time from t+1 are left out.

    Cost: a lookup for each point, and a few more for each point that is kept.
    """
    is_kept = lookup(wanted, objects.of_pixel) & (sweeps.elapsed_of_pixel.abs() <= most_time)
    points = flat_nonzero(lookup(is_kept, sweeps.pixel_of_point))
    pixel, rows = gather(points, sweeps.pixel_of_point, sweeps.row_of_point)
    position = take_columns(sweeps.batch.positions, rows)
    layer = slice_of(position[2], slice_height, num_slices).long()
    times = sweeps.batch.point_times
    time = None if times is None else times.index_select(0, rows)
    return ObjectPoints(objects.of_pixel.index_select(0, pixel), pixel, layer, position, time)


class Voxels:
    """V voxels that contain points of objects, sorted by pixel, then by slice.

    Convention: coordinates are rounded to the nearest unit, and their mean is rounded down.

    Cost: a sort of the points.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_slices: int) -> None:
        self._sweeps, self.num_slices, self.num_steps = sweeps, num_slices, sweeps.num_steps
        key, voxel, count = torch.unique(
            points.pixel * num_slices + points.layer, return_inverse=True, return_counts=True
        )
        # (V,) int64 each, of the voxels.
        self.pixel, self.layer = split_index(key, num_slices)
        self.window, self.step = take_columns(sweeps.pixels.table[1:3], self.pixel)
        # All points of a voxel belong to one object, so it does not matter which of them is written last.
        self.object_id = torch.empty_like(key).scatter_(0, voxel, points.object_id)
        corner = constant((*sweeps.grid.lower[:2], 0.0), torch.float64, key.device)[:, None]
        # Coordinates are clamped far beyond a region, so that no square overflows.
        position = ((points.position - corner) * UNITS).round_().clamp_(-(2.0**24), 2.0**24)
        centroid = torch.floor(scatter_count(voxel, len(key), position) / count)
        # (3, V + 1) float64, x and y from the lower corner of the region and z from 0, units; the last entry, for "no
        # voxel", is far away.
        self.position = F.pad(centroid, (0, 1), value=2.0**27)
        # The first row of the table is for "no pixel", which has rank 0 in `HeightSlicedSweeps.rank`.
        self._of_key = torch.full((num_slices * (sweeps.num_pixels + 1),), len(key), device=key.device)
        self._of_key.scatter_(0, key + num_slices, torch.arange(len(key), device=key.device))
        self.time: Tensor | None = None  # (V,) float64, mean of the times of the points
        if points.time is not None:
            self.time = scatter_count(voxel, len(key), points.time.double()) / count

    def nearest(self, sweep: Tensor, layers: Tensor, position: Tensor, farthest: float) -> tuple[Tensor, Tensor]:
        """Find the nearest voxel of a sweep in the 3 x 3 pixels around a position.

        Args:
            sweep: (K,) int64, window * S + step.
            layers: (L, K) int64, the slices to search in.
            position: (3, K) float64, whole units, anywhere.
            farthest: metres.

        Returns:
            voxel: (K,) int64, V = not found. Ties: the first slice of the first pixel in raster order.
            is_near: (K,) bool, found and at most `farthest` away. The square of `farthest` is rounded to square units.

        Cost: 9 L lookups for each position.
        """
        voxel = self.around(sweep, layers, position, 1)
        apart = take_columns(self.position, voxel.view(-1)).view(3, *voxel.shape).sub_(position[:, None])
        # Square and slot share one number, because taking the minimum is several times faster than argmin. It is many
        # times faster in float64, which holds these numbers exactly, than in int64.
        slot = constant(tuple(range(len(voxel))), torch.float64, position.device)[:, None]
        key = torch.add(slot, apart.square_().sum(0), alpha=32).amin(0)
        is_near = key < 32 * (round((farthest * UNITS) ** 2) + 1)
        return voxel.gather(0, (key.long() & 31)[None])[0], is_near

    def around(self, sweep: Tensor, layers: Tensor, position: Tensor, reach: int) -> Tensor:
        """Return the voxels of a sweep in the pixels around a position, `reach` pixels each way.

        Args:
            sweep, layers, position: as for `nearest`; z is ignored.
            reach: r, pixels.

        Returns:
            ((2 r + 1)^2 L, K) int64, pixel by pixel in raster order, V = no voxel. Near the border and beyond it, we
            take the outermost pixels.
        """
        grid, device, line = self._sweeps.grid, layers.device, range(-reach, reach + 1)
        ends = ((reach, reach), (grid.width - 1 - reach, grid.height - 1 - reach))
        lowest, highest = constant(ends, torch.float64, device)[..., None]
        size = constant((grid.pixel_size * UNITS,), torch.float64, device)
        col, row = (position[:2] / size).clamp_(lowest, highest).long()
        pixel = torch.add(col, row, alpha=grid.width).add_(sweep, alpha=grid.height * grid.width)
        offsets = constant(tuple(dy * grid.width + dx for dy in line for dx in line), torch.int64, device)
        pixel = pixel + offsets[:, None]
        if min(grid.height, grid.width) <= 2 * reach:
            pixel.clamp_(0, self._sweeps.rank.numel() - 1)
        rank = self._sweeps.rank.index_select(0, pixel.view(-1)).view(len(pixel), 1, -1)
        key = torch.add(layers, rank, alpha=self.num_slices).view(-1)
        return self._of_key.index_select(0, key).view(len(pixel) * len(layers), -1)


def spread_of(voxels: Voxels, pixel_size: float, layer_height: float) -> Tensor:
    """Return for each voxel the covariance of the centroids around it that belong to its object and sweep.

    A block has 2 x 2 x 2 voxels. The centroids around a voxel are those in its block and in the 26 adjacent blocks. The
    result is (3, 3, V) float64, squares of units of 1 / `UNITS` m. `pixel_size` and `layer_height` are in metres.

    Cost: 18 searches for each block.
    """
    position, device = voxels.position[:, :-1], voxels.position.device
    xyz = torch.floor(position / _STEP).long()
    one_xyz = torch.cat((torch.ones_like(xyz[:1]), xyz))  # `F.pad` of torch 2.0 fails without voxels
    first, second = (one_xyz.index_select(0, constant(of, torch.int64, device)) for of in _FACTORS)
    side = tuple(_SIDE * UNITS * of_voxel for of_voxel in (pixel_size, pixel_size, layer_height))
    block = torch.floor(position / constant(side, torch.float64, device)[:, None]).long()
    sums = _sums_around(block, voxels.object_id * voxels.num_steps + voxels.step, first * second).double()
    n, total = sums[0], sums[1:4]  # number of voxels around, sums of their coordinates
    squares = sums.index_select(0, constant(_SQUARES, torch.int64, device)).view(3, 3, -1)
    return (n * squares - total[:, None] * total) * _STEP**2 / (n * n)


def _sums_around(block: Tensor, image: Tensor, values: Tensor) -> Tensor:
    """Return the sums of values, (R, V) int64, over the 27 blocks around the block of each voxel, in the same image.

    `block`, (3, V) int64, has columns, rows and layers; layers beyond +-2046 are merged.
    """
    column = torch.add(block[0], torch.add(block[1], image, alpha=_ROW), alpha=_ROW)
    layer = block[2].clamp(2 - _LAYER // 2, _LAYER // 2 - 2)
    key, of_voxel = torch.unique(torch.add(layer, column, alpha=_LAYER), return_inverse=True)
    # The layers of a column follow each other in the order of keys, so the sum over three layers is a difference of two
    # running sums. Running sums may overflow, but their differences are right.
    below = scatter_count(of_voxel, len(key), values).cumsum(1)
    below = F.pad(below, (1, 0)).t().contiguous()
    columns = [(down * _ROW + right) * _LAYER for down in (-1, 0, 1) for right in (-1, 0, 1)]
    ends = constant(tuple(column + end for end in (-1, 2) for column in columns), torch.int64, key.device)
    sums = torch.empty_like(below[1:])
    for some in chunks(0, len(key), key.device, ends.numel() * len(values)):
        at = torch.searchsorted(key, key[some] + ends[:, None])
        first, last = below.index_select(0, at.view(-1)).view(2, 9, -1, len(values))
        sums[some] = (last - first).sum(0)
    return take_columns(sums.t(), of_voxel)
