"""Sub-pixel shift of objects: the best of the whole-pixel shifts near their motion, and a parabola.

One grid of pixels cuts a small object badly by chance. Counts are therefore summed over grids that are moved by half a
pixel, in x, in y, and in both.
"""

from __future__ import annotations

import math
from typing import List, Sequence, Set, Tuple

from oracle.height_slices import SlicedSweeps, Vector, vertex
from oracle.voxel_centroids import Point

GRIDS = 2  # by 2
REACH = 1  # pixels, farthest shift from the given motion; counts are needed one pixel further


def shift_between_pixels(points: Sequence[Point], flow: Sequence[Vector], sweeps: SlicedSweeps) -> List[Vector]:
    """The motion t -> t+1 of every object where most of its voxels at t meet one at t+1.

    Args:
        points: of all objects; those of t and t+1 matter.
        flow: of each object, (y, x) pixels per sweep interval.
        sweeps: the window.

    Returns:
        Of each object, (y, x) pixels per sweep interval. One that meets nothing keeps its flow.

    Convention:
        The given motion is rounded to whole pixels, halves up. Of equal counts the shift nearest to it, of those the
        first in raster order. A voxel of t+1 counts whatever its object is.
    """
    grids = [(a, b) for a in range(GRIDS) for b in range(GRIDS)]
    newest = [place_voxels([p for p in points if p.step == 0], grid, sweeps) for grid in grids]
    around = [(dy, dx) for dy in range(-REACH - 1, REACH + 2) for dx in range(-REACH - 1, REACH + 2)]
    result: List[Vector] = []
    for owner, (f_y, f_x) in enumerate(flow):
        start = math.floor(f_y + 0.5), math.floor(f_x + 0.5)
        own = [p for p in points if p.step == 1 and p.owner == owner]
        at_t = [place_voxels(own, grid, sweeps) for grid in grids]
        count = {
            (dy, dx): sum(
                (row + start[0] + dy, col + start[1] + dx, part) in new
                for old, new in zip(at_t, newest)
                for row, col, part in old
            )
            for dy, dx in around
        }
        searched = [shift for shift in around if max(abs(shift[0]), abs(shift[1])) <= REACH]
        y, x = min(searched, key=lambda shift: (-count[shift], shift[0] ** 2 + shift[1] ** 2, shift))
        if count[y, x] == 0:
            result.append((f_y, f_x))
            continue
        d_y = vertex(count[y - 1, x], count[y, x], count[y + 1, x])
        d_x = vertex(count[y, x - 1], count[y, x], count[y, x + 1])
        result.append((start[0] + (y + d_y), start[1] + (x + d_x)))
    return result


def place_voxels(points: Sequence[Point], grid: Tuple[int, int], sweeps: SlicedSweeps) -> Set[Tuple[int, int, int]]:
    """(row, column, slice) of points on a grid that is moved back by a fraction of a pixel in y and in x."""
    (x0, y0), size, (down, right) = sweeps.lower, sweeps.pixel_size, grid
    return {
        (math.floor((p.y - y0) / size + down / GRIDS), math.floor((p.x - x0) / size + right / GRIDS), p.part)
        for p in points
    }
