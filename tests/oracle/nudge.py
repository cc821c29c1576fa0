"""Large moving groups: the motion is moved where centroids meet better beyond doubt (docs/beyond.md)."""

from __future__ import annotations

import math
from typing import List, Sequence, Tuple

from oracle.refinement import UNITS, Point, centroids
from oracle.slow import best_shift

STEP = 26  # units between shifts that are judged
REACH = 2  # steps
Z = 3.0  # standard deviations of luck that a shift is granted
LEAST_GAIN = 1  # 40ths of a perfect meeting that a shift must gain per cube
LEAST_CUBES = 400


def nudge(
    points: Sequence[Point],
    flow: Sequence[Tuple[float, float]],
    interval: float,
    lower: Tuple[float, float],
    pixel_size: float,
) -> List[Tuple[float, float]]:
    """The motion of groups between t and t+1, moved where that is proved.

    Args:
        points: of all groups, both sweeps.
        flow: of each group, (y, x) pixels per sweep interval.
        interval: sweep intervals from t to t+1.
        lower: lower corner of the region, metres.
        pixel_size: metres.

    Returns:
        Of each group, (y, x) pixels per sweep interval.
    """
    cubes, unit = centroids(points, lower, pixel_size), pixel_size * UNITS
    result = []
    for group, (f_y, f_x) in enumerate(flow):
        members = [cube for cube in cubes.values() if cube.group == group]
        start = math.floor(f_x * unit * interval + 0.5), math.floor(f_y * unit * interval + 0.5)
        best = best_shift(cubes, members, start, pixel_size, REACH, STEP, Z, LEAST_GAIN, LEAST_CUBES)
        x, y = (0, 0) if best is None else best
        result.append((f_y + y / unit / interval, f_x + x / unit / interval))
    return result
