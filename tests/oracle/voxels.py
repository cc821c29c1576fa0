"""Voxels (pixels by height slices of every sweep) of objects, and the centroids of their points."""

from __future__ import annotations

import math
from typing import Dict, NamedTuple, Sequence, Tuple

from oracle.height_slices import NEAR, Pixel, SlicedSweeps, slice_of

LAYERS = 32  # slices of the registration, then they repeat
UNITS = 1024  # of a metre: centroids are whole numbers of them


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


def voxels_of(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], wanted: Sequence[bool], height: float, num_slices: int
) -> Voxels:
    """Voxels, so many metres high, that hold points of the objects wanted: each coordinate rounded to the nearest unit,
    their mean down to a whole one."""
    (x0, y0), inside = sweeps.lower, {}  # type: ignore[var-annotated]
    for pixel, p in sweeps.points():
        if pixel in object_of and wanted[object_of[pixel]]:
            inside.setdefault((*pixel, slice_of(p.z, height, num_slices)), []).append(p)
    voxels = {}
    for (m, row, col, layer), own in inside.items():
        x = sum(round((p.x - x0) * UNITS) for p in own) // len(own)
        y = sum(round((p.y - y0) * UNITS) for p in own) // len(own)
        z = sum(min(max(round(p.z * UNITS), -(2**24)), 2**24) for p in own) // len(own)
        time = sum(p.time for p in own) / len(own)
        voxels[m, row, col, layer] = Voxel(m, layer, object_of[m, row, col], x, y, z, time)
    return voxels


def centre_pixel(x: float, y: float, sweeps: SlicedSweeps, reach: int) -> tuple[int, int]:
    """Row and column of a position in units. At the border and beyond it, they are `reach` pixels within the image."""
    row, col = (math.floor(at / (sweeps.size * UNITS)) for at in (y, x))
    height, width = sweeps.shape
    return min(max(row, reach), height - 1 - reach), min(max(col, reach), width - 1 - reach)


def nearest(voxels: Voxels, step: int, layer: int, x: float, y: float, z: float, sweeps: SlicedSweeps) -> Voxel | None:
    """The nearest of the voxels in the 3 x 3 pixels around a position, in its slice and those next to it; the last
    slice is below the first one. Ties: the first pixel in raster order, then the lowest slice."""
    row, col = centre_pixel(x, y, sweeps, 1)
    near = [(step, row + dy, col + dx, (layer + up) % LAYERS) for dy, dx in NEAR for up in (-1, 0, 1)]
    found = [voxels[index] for index in near if index in voxels]
    return min(found, key=lambda voxel: (voxel.x - x) ** 2 + (voxel.y - y) ** 2 + (voxel.z - z) ** 2, default=None)
