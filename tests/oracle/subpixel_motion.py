"""Sub-pixel motion of pairs: slow objects, found by how well the centroids of small cubes meet."""

from __future__ import annotations

import math
from typing import NamedTuple, Sequence, Tuple

import numpy as np

from oracle.height_slices import Cell, Pixel, SlicedSweeps, Vector, count
from oracle.voxels import UNITS, Voxel, Voxels, around, centroids, meeting_weight, points_of_objects

SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
BIAS_Z, LEAST_BIAS = 3, 10  # standard deviations of noise of a bias; and it must be a 10th of the object's slices
NUM_LAYERS = 16  # layers of cubes are told apart by this many numbers, then they repeat
SIGMA = 0.07  # metres, of the weight of two centroids
STEP, REACH = 51, 3  # units between shifts that are tested; steps each way
Z, LEAST_GAIN, LEAST_CUBES = 4.0, 0.05, 6  # significance; gain per cube, as a share of a perfect meeting; cubes
BLOCK, AROUND = 410, 2  # units, side of the blocks that vote; pixels in which a cube meets others

Shift = Tuple[int, int]  # x, y, units, from t to t+1


class Cube(NamedTuple):
    """Where a cube lies, units, and the ways (N, 2) to the cubes around it."""

    block: Cell
    ways: np.ndarray


def subpixel_motion(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], motions: Sequence[Vector], may_be_slow: Sequence[bool]
) -> list[Vector]:
    """The motion of the objects of a pair, (x, y) metres per interval, from (y, x) pixels per interval, 0 = static;
    what moves keeps its motion."""
    slow = []
    for owner, motion in enumerate(motions):
        members = [pixel for pixel, own in object_of.items() if own == owner]
        slow.append(may_be_slow[owner] and not any(motion) and is_biased(sweeps, members))
    every = centroids(points_of_objects(sweeps, object_of, slow, sweeps.size, NUM_LAYERS), sweeps)
    result = [(x * sweeps.size, y * sweeps.size) for y, x in motions]
    for owner in [owner for owner, is_slow in enumerate(slow) if is_slow]:
        cubes = [cube_of(every, voxel, sweeps) for voxel in every.values() if voxel.owner == owner]
        best = best_shift(cubes)
        if best is not None:
            best = best_shift(moving_parts(cubes, best))
        if best is not None:
            x, y = (way / UNITS / sweeps.elapsed[1] for way in best)
            result[owner] = (x, y)
    return result


def is_biased(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """Whether an object matches more of the other sweep a pixel ahead than a pixel behind, or the other way round."""
    size = sum(count(sweeps.at(*pixel)) for pixel in members)
    for dy, dx in SIDES:
        a, b = 0, 0
        for m, r, c in members:
            way = 1 if m == 1 else -1
            ahead = sweeps.at(m, r, c) & sweeps.at(1 - m, r + way * dy, c + way * dx)
            behind = sweeps.at(m, r, c) & sweeps.at(1 - m, r - way * dy, c - way * dx)
            a, b = a + count(ahead & ~behind), b + count(behind & ~ahead)
        if (a - b) ** 2 >= BIAS_Z**2 * (a + b) and abs(a - b) * LEAST_BIAS >= size > 0:
            return True
    return False


def cube_of(every: Voxels, voxel: Voxel, sweeps: SlicedSweeps) -> Cube:
    """A cube of an object and what it may meet: the cubes of the other sweep, in its layer, in the 5 x 5 pixels around
    it. Cubes of t+1 go back. Ways are float32."""
    sign = 1 if voxel.step == 1 else -1
    near = around(every, 1 - voxel.step, voxel.part, voxel.x, voxel.y, sweeps, AROUND)
    ways = [(sign * (other.x - voxel.x), sign * (other.y - voxel.y)) for other in near]
    return Cube((voxel.y // BLOCK, voxel.x // BLOCK), np.array(ways, dtype=np.float32).reshape(-1, 2))


def best_shift(cubes: Sequence[Cube]) -> Shift | None:
    """The most significant shift, None = none is.

    Ties: the smallest, then raster order.
    """
    line = [STEP * i for i in range(-REACH, REACH + 1)]
    values = {}
    for shift in [(x, y) for y in line for x in line]:
        gain = gains(cubes, shift)
        is_weak = sum(gain) < LEAST_GAIN * len(cubes) or len(cubes) < LEAST_CUBES
        values[shift] = 0.0 if is_weak else sum(gain) - Z * math.sqrt(sum(g * g for g in gain))
    by_length = sorted(values, key=lambda shift: shift[0] ** 2 + shift[1] ** 2)
    best = max(by_length, key=lambda shift: values[shift])
    return best if values[best] > 0 else None


def moving_parts(cubes: Sequence[Cube], shift: Shift) -> list[Cube]:
    """The cubes that lie in blocks that gain by a shift: of an object that moves a part may be static."""
    total: dict[Cell, float] = {}
    for cube, gain in zip(cubes, gains(cubes, shift)):
        total[cube.block] = total.get(cube.block, 0.0) + gain
    return [cube for cube in cubes if total[cube.block] > 0]


def gains(cubes: Sequence[Cube], shift: Shift) -> list[float]:
    """Weight that each cube gains by a shift."""
    return [meet(cube, shift) - meet(cube, (0, 0)) for cube in cubes]


def meet(cube: Cube, shift: Shift) -> float:
    """Weight, 1 at most, of what a cube meets at a shift."""
    x, y = (cube.ways - np.array(shift, dtype=np.float32)).T
    return meeting_weight(float((x * x + y * y).min()), SIGMA) if len(x) else 0.0
