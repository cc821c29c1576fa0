"""Voxels (pixels by height slices of every sweep) of objects, and the centroids of their points."""

from __future__ import annotations

import math
from itertools import product
from typing import Dict, NamedTuple, Sequence, Tuple

from oracle.height_slices import Pixel, SlicedSweeps, slice_of

LAYERS = 32  # slices of the registration, then they repeat
UNITS = 1024  # of a metre: centroids are whole numbers of them


class Point(NamedTuple):
    """A point of an object: sweep, slice, object, metres, sweep intervals since the instant of the sweep."""

    step: int
    layer: int
    object_id: int
    x: float
    y: float
    z: float
    time: float


class Voxel(NamedTuple):
    """Sweep, slice and object of some points of a pixel, their centroid in units from the lower corner and z = 0, and
    their mean time."""

    step: int
    layer: int
    object_id: int
    x: int
    y: int
    z: int
    time: float


Voxels = Dict[Tuple[int, int, int, int], Voxel]  # by step, row, column, slice


def points_of_objects(
    sweeps: SlicedSweeps,
    object_of: dict[Pixel, int],
    wanted: Sequence[bool],
    height: float,
    num_slices: int,
) -> list[Point]:
    """Points of the objects wanted, in all sweeps; slices are so many metres high."""
    points = []
    for m, cloud in enumerate(sweeps.clouds):
        for x, y, z, time in cloud:
            object_id = object_of.get((m, *sweeps.pixel(x, y)), -1)
            if object_id >= 0 and wanted[object_id]:
                points.append(Point(m, slice_of(z, height, num_slices), object_id, x, y, z, time))
    return points


def centroids(points: Sequence[Point], sweeps: SlicedSweeps) -> Voxels:
    """Voxels that hold points: each coordinate rounded to the nearest unit, their mean down to a whole one."""
    (x0, y0), inside = sweeps.lower, {}  # type: ignore[var-annotated]
    for p in points:
        inside.setdefault((p.step, *sweeps.pixel(p.x, p.y), p.layer), []).append(p)
    voxels = {}
    for index, own in inside.items():
        x = sum(whole((p.x - x0) * UNITS) for p in own) // len(own)
        y = sum(whole((p.y - y0) * UNITS) for p in own) // len(own)
        z = sum(min(max(whole(p.z * UNITS), -(2**24)), 2**24) for p in own) // len(own)
        time = sum(p.time for p in own) / len(own)
        voxels[index] = Voxel(own[0].step, own[0].layer, own[0].object_id, x, y, z, time)
    return voxels


def around(
    voxels: Voxels, step: int, layer: int, x: float, y: float, sweeps: SlicedSweeps, reach: int, layers: int = 0
) -> list[Voxel]:
    """Voxels of a sweep in the pixels around a position in units, `reach` each way, in raster order, in the slice and
    in `layers` below and above it. At the border and beyond it, they are the outermost pixels."""
    row, col = (
        min(max(math.floor(at / (sweeps.size * UNITS)), reach), length - 1 - reach)
        for at, length in zip((y, x), sweeps.shape)
    )
    slices = [(layer + up) % LAYERS for up in range(-layers, layers + 1)]
    pixels = product(range(-reach, reach + 1), repeat=2)
    near = [(step, row + dy, col + dx, of_slice) for dy, dx in pixels for of_slice in slices]
    return [voxels[index] for index in near if index in voxels]


def nearest(voxels: Voxels, step: int, layer: int, x: float, y: float, z: float, sweeps: SlicedSweeps) -> Voxel | None:
    """The nearest of the voxels in the 3 x 3 pixels around a position, in its slice and those next to it; the last
    slice is below the first one. Ties: the first pixel in raster order, then the lowest slice."""
    found = around(voxels, step, layer, x, y, sweeps, 1, 1)
    return min(found, key=lambda voxel: (voxel.x - x) ** 2 + (voxel.y - y) ** 2 + (voxel.z - z) ** 2, default=None)


def meeting_weight(squared_distance: float, sigma: float) -> float:
    """exp(-d^2 / 2 sigma^2) of two centroids, in 256ths, of d^2 in steps of 64 square units of which 2048 count."""
    step = squared_distance // 64
    return whole(256 * math.exp(-(64 * step + 32) / (2 * (sigma * UNITS) ** 2))) / 256 if step < 2048 else 0.0


def whole(x: float) -> int:
    """Nearest whole number, halves up."""
    return math.floor(x + 0.5)
