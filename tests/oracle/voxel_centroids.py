"""Voxels (pixels by height slices of every sweep) of objects, and the centroids of their points."""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import NUM_SLICES, SLICE_HEIGHT, Pixel, SlicedSweeps, slice_of
from oracle.pixels import project_bev

UNITS = 1024  # of a metre: centroids are whole numbers of them


class Point(NamedTuple):
    """A point of an object: sweep, height slice, object, place in metres (frame of t+1), time in sweep intervals."""

    step: int
    part: int
    owner: int
    x: float
    y: float
    time: float = 0.0


class Voxel(NamedTuple):
    """Sweep, height slice and object of some points of a pixel, their centroid in units from the lower corner, and the
    mean of their times."""

    step: int
    part: int
    owner: int
    x: int
    y: int
    time: float


Place = Tuple[int, int, int, int]  # step, row, col, part
Voxels = Dict[Place, Voxel]


def points_of_objects(
    wanted: Sequence[bool],
    object_of: Dict[Pixel, int],
    clouds: Sequence[np.ndarray],
    config: VerifiedConfig,
    slice_height: float = SLICE_HEIGHT,
    num_slices: int = NUM_SLICES,
    times: Optional[Sequence[np.ndarray]] = None,
) -> List[Point]:
    """Points of some objects.

    Args:
        wanted: of each object.
        object_of: object of each pixel that belongs to one.
        clouds: (N, 3) float64 of t+1, t, t-1, ..., the points that are drawn.
        config: for the finest pixels.
        slice_height, num_slices: metres, and how many slices are told apart.
        times: (N,) of each of the clouds, sweep intervals; None = all 0.
    """
    points = []
    for m, cloud in enumerate(clouds):
        late = [0.0] * len(cloud) if times is None else times[m].tolist()
        pixels = project_bev(cloud, config, config.pixel_sizes[-1]).tolist()
        for (r, c), (x, y, z), time in zip(pixels, cloud.tolist(), late):
            owner = object_of.get((m, r, c), -1)
            if owner >= 0 and wanted[owner]:
                points.append(Point(m, slice_of(z, slice_height, num_slices), owner, x, y, time))
    return points


def centroids(points: Sequence[Point], sweeps: SlicedSweeps) -> Voxels:
    """Voxels that hold points: each coordinate rounded to the nearest unit, their mean down to a whole one."""
    (x0, y0), size = sweeps.lower, sweeps.pixel_size
    members: Dict[Place, List[Point]] = {}
    for p in points:
        place = p.step, math.floor((p.y - y0) / size), math.floor((p.x - x0) / size), p.part
        members.setdefault(place, []).append(p)
    voxels = {}
    for place, inside in members.items():
        x = sum(whole((p.x - x0) * UNITS) for p in inside) // len(inside)
        y = sum(whole((p.y - y0) * UNITS) for p in inside) // len(inside)
        time = sum(p.time for p in inside) / len(inside)
        voxels[place] = Voxel(inside[0].step, inside[0].part, inside[0].owner, x, y, time)
    return voxels


def around(voxels: Voxels, step: int, part: int, x: float, y: float, pixel_size: float, reach: int) -> List[Voxel]:
    """Voxels of a sweep and slice in the pixels around a place in units, `reach` each way, in raster order."""
    row, col = math.floor(y / (pixel_size * UNITS)), math.floor(x / (pixel_size * UNITS))
    near = range(-reach, reach + 1)
    places = [(step, row + dy, col + dx, part) for dy in near for dx in near]
    return [voxels[place] for place in places if place in voxels]


def nearest(voxels: Voxels, step: int, part: int, x: float, y: float, pixel_size: float) -> Optional[Voxel]:
    """The nearest of the voxels in the 3 x 3 pixels around a place; of equals the first in raster order."""
    found = around(voxels, step, part, x, y, pixel_size, 1)
    return min(found, key=lambda voxel: (voxel.x - x) ** 2 + (voxel.y - y) ** 2, default=None)


def meeting_weight(squared_distance: float, sigma: float) -> float:
    """exp(-d^2 / 2 sigma^2) of two centroids, in 256ths, of d^2 in steps of 64 square units of which 2048 count."""
    step = squared_distance // 64
    if step >= 2048:
        return 0.0
    return whole(256 * math.exp(-(64 * step + 32) / (2 * (sigma * UNITS) ** 2))) / 256


def whole(x: float) -> int:
    """Nearest whole number, halves up."""
    return math.floor(x + 0.5)
