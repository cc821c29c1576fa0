"""Relocation of groups: the best of the whole-pixel shifts near their motion, and a parabola (docs/beyond.md).

One grid of pixels cuts a small object badly by chance. Counts are therefore summed over grids that are moved by half a
pixel, in x, in y, and in both.
"""

from __future__ import annotations

import math
from typing import Dict, List, Sequence, Set, Tuple

from oracle.refinement import Point

GRIDS = 2  # by 2
REACH = 1  # pixels, farthest shift from the given motion; counts are needed one pixel further

Cell = Tuple[int, int, int, int]  # window, row, col, part


def relocate(
    points: Sequence[Point], flow: Sequence[Tuple[float, float]], lower: Tuple[float, float], pixel_size: float
) -> List[Tuple[float, float]]:
    """The motion t -> t+1 of every group where most of its voxels at t meet one at t+1.

    Args:
        points: of all groups; those of t and t+1 matter.
        flow: of each group, (y, x) pixels per sweep interval.
        lower: lower corner of the region, metres.
        pixel_size: metres.

    Returns:
        Of each group, (y, x) pixels per sweep interval. One that meets nothing keeps its flow.

    Convention:
        The given motion is rounded to whole pixels, halves up. Of equal counts the shift nearest to it, of those the
        first in raster order. A voxel of t+1 counts whatever its group is.
    """
    result: List[Tuple[float, float]] = []
    grids = [(a, b) for a in range(GRIDS) for b in range(GRIDS)]
    newest = [cells([p for p in points if p.step == 0], grid, lower, pixel_size) for grid in grids]
    for group, (f_y, f_x) in enumerate(flow):
        at_t = [p for p in points if p.step == 1 and p.group == group]
        start = math.floor(f_y + 0.5), math.floor(f_x + 0.5)
        count: Dict[Tuple[int, int], int] = {}
        around = [(dy, dx) for dy in range(-REACH - 1, REACH + 2) for dx in range(-REACH - 1, REACH + 2)]
        for dy, dx in around:
            count[dy, dx] = sum(
                (window, row + start[0] + dy, col + start[1] + dx, part) in new
                for grid, new in zip(grids, newest)
                for window, row, col, part in cells(at_t, grid, lower, pixel_size)
            )
        searched = [shift for shift in around if max(abs(shift[0]), abs(shift[1])) <= REACH]
        y, x = min(searched, key=lambda shift: (-count[shift], shift[0] ** 2 + shift[1] ** 2, shift))
        if count[y, x] == 0:
            result.append((f_y, f_x))
            continue
        d_y = vertex(count[y - 1, x], count[y, x], count[y + 1, x])
        d_x = vertex(count[y, x - 1], count[y, x], count[y, x + 1])
        result.append((start[0] + (y + d_y), start[1] + (x + d_x)))
    return result


def cells(points: Sequence[Point], grid: Tuple[int, int], lower: Tuple[float, float], pixel_size: float) -> Set[Cell]:
    """Voxels of points on a grid that is moved back by a fraction of a pixel in y and in x."""
    return {
        (
            p.window,
            math.floor((p.y - lower[1]) / pixel_size + grid[0] / GRIDS),
            math.floor((p.x - lower[0]) / pixel_size + grid[1] / GRIDS),
            p.part,
        )
        for p in points
    }


def vertex(low: int, middle: int, high: int) -> float:
    """Where the parabola through three counts, one apart, is largest: at most half a step from the middle one."""
    curve = 2 * middle - low - high
    if curve <= 0:
        return 0.0
    return min(max((high - low) / (2 * curve), -0.5), 0.5)
