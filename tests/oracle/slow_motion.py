"""Slow motion: of a pixel or less between two sweeps, verified on the centroids of small cubes."""

from __future__ import annotations

import math
from typing import Dict, List, Optional, Sequence, Tuple

from oracle.height_slices import Pixel, SlicedSweeps, Vector, count, vertex
from oracle.voxel_centroids import UNITS, Point, Voxel, Voxels, around, centroids, meeting_weight

SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
LEAN_Z = 3  # standard deviations of noise for a lean
LEAST_LEAN = 10  # and it must be a 10th of the object's slices
NUM_LAYERS = 16  # cubes are told apart by this many layers as high as a pixel is wide, then they repeat
SIGMA = 0.07  # metres, of the weight of two centroids
STEP, REACH = 51, 3  # units between shifts that are tested; steps each way
Z = 4.0  # standard deviations of noise that a shift is granted
LEAST_GAIN = 0.05  # share of a perfect meeting that a shift must gain per cube
LEAST_CUBES = 6
BLOCK = 410  # units, side of the blocks that vote
AROUND = 2  # pixels in which a cube looks for others

Shift = Tuple[int, int]  # x, y, units, from t to t+1
Neighbours = Sequence[Sequence[Voxel]]  # what each of some cubes may meet


def leans(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """Whether an object meets more of the other sweep a pixel ahead than a pixel behind, or the other way round."""
    size = sum(count(sweeps.at(*pixel)) for pixel in members)
    for dy, dx in SIDES:
        a, b = 0, 0
        for m, r, c in members:
            way = 1 if m == 1 else -1
            ahead = sweeps.at(m, r, c) & sweeps.at(1 - m, r + way * dy, c + way * dx)
            behind = sweeps.at(m, r, c) & sweeps.at(1 - m, r - way * dy, c - way * dx)
            a += count(ahead & ~behind)
            b += count(behind & ~ahead)
        if (a - b) ** 2 >= LEAN_Z**2 * (a + b) and abs(a - b) * LEAST_LEAN >= size > 0:
            return True
    return False


def slow_motion(points: Sequence[Point], num_objects: int, sweeps: SlicedSweeps) -> List[Optional[Vector]]:
    """The motion of slow objects between t and t+1.

    Args:
        points: of the objects that lean, of both sweeps; `part` is the layer, 0 ... 15.
        num_objects: how many objects there are.
        sweeps: the window.

    Returns:
        Of each object, (x, y) metres per sweep interval; None = no motion is significant.
    """
    cubes, interval = centroids(points, sweeps), sweeps.elapsed[1]
    result: List[Optional[Vector]] = [None] * num_objects
    for owner in range(num_objects):
        members = [cube for cube in cubes.values() if cube.owner == owner]
        near = [neighbours(cubes, cube, sweeps.pixel_size) for cube in members]
        best = best_shift(members, near)
        if best is not None:
            members = moving_parts(members, near, best)
            near = [neighbours(cubes, cube, sweeps.pixel_size) for cube in members]
            best = best_shift(members, near)
        if best is None:
            continue
        x, y = best
        beside = [(x, y), (x - STEP, y), (x + STEP, y), (x, y - STEP), (x, y + STEP)]
        middle, left, right, below, above = (sum(gains(members, near, shift)) for shift in beside)
        d_x, d_y = vertex(left, middle, right), vertex(below, middle, above)
        result[owner] = ((x + d_x * STEP) / UNITS / interval + 0.0, (y + d_y * STEP) / UNITS / interval + 0.0)
    return result


def best_shift(members: Sequence[Voxel], near: Neighbours) -> Optional[Shift]:
    """The shift that is most significant; of equals the first in raster order; None = none is."""
    if len(members) < LEAST_CUBES:
        return None
    line = [STEP * i for i in range(-REACH, REACH + 1)]
    best, most = None, 0.0
    for shift in [(x, y) for y in line for x in line]:
        gain = gains(members, near, shift)
        value = sum(gain) - Z * math.sqrt(sum(g * g for g in gain))
        if value > most and sum(gain) >= LEAST_GAIN * len(members):
            best, most = shift, value
    return best


def moving_parts(members: Sequence[Voxel], near: Neighbours, shift: Shift) -> List[Voxel]:
    """The cubes that lie in blocks that gain by a shift: of an object that moves a part may stand still."""
    total: Dict[Tuple[int, int], float] = {}
    for cube, gain in zip(members, gains(members, near, shift)):
        block = cube.y // BLOCK, cube.x // BLOCK
        total[block] = total.get(block, 0.0) + gain
    return [cube for cube in members if total[cube.y // BLOCK, cube.x // BLOCK] > 0]


def gains(members: Sequence[Voxel], near: Neighbours, shift: Shift) -> List[float]:
    """Weight that each cube gains by a shift."""
    return [meet(cube, others, shift) - meet(cube, others, (0, 0)) for cube, others in zip(members, near)]


def neighbours(cubes: Voxels, cube: Voxel, pixel_size: float) -> List[Voxel]:
    """Cubes of the other sweep in the 5 x 5 pixels around a cube, in its layer."""
    return around(cubes, 1 - cube.step, cube.part, cube.x, cube.y, pixel_size, AROUND)


def meet(cube: Voxel, near: Sequence[Voxel], shift: Shift) -> float:
    """Weight, 1 at most, of what a cube meets at a shift from t to t+1; that of t+1 is moved back."""
    way = 1 if cube.step == 1 else -1
    x, y = cube.x + way * shift[0], cube.y + way * shift[1]
    squares = [(other.x - x) ** 2 + (other.y - y) ** 2 for other in near]
    return meeting_weight(min(squares), SIGMA) if squares else 0.0
