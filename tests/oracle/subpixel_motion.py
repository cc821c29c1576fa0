"""Sub-pixel motion of pairs: slow objects, found by how well the centroids of small cubes meet."""

from __future__ import annotations

import math
from typing import Sequence

import numpy as np

from oracle.height_slices import Pixel, SlicedSweeps, Vector, count
from oracle.voxels import UNITS, Voxel, Voxels, around, centroids, meeting_weight, points_of_objects, whole

SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
BIAS_Z, LEAST_BIAS = 3, 10  # standard deviations of noise of a bias; and it must be a 10th of the object's slices
NUM_LAYERS = 16  # layers of cubes are told apart by this many numbers, then they repeat
SIGMA = 0.07  # metres, of the weight of two centroids
NUM_STEPS, STEP_LENGTH, FARTHEST = 4, 2, 154  # steps to the best shift, their length, its largest side in units
Z, LEAST_GAIN, LEAST_CUBES = 4.0, 0.05, 6  # significance; gain per cube, as a share of a perfect meeting; cubes
AROUND = 2  # pixels in which a cube meets others

Cube = np.ndarray  # (N, 2): where the cubes around it are, seen from it, units, from t to t+1


def subpixel_motion(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], motions: Sequence[Vector], may_be_slow: Sequence[bool]
) -> list[Vector]:
    """The motion of the objects of a pair, (x, y) metres per interval, from (y, x) pixels per interval, 0 = static;
    what moves keeps its motion."""
    slow = []
    for object_id, motion in enumerate(motions):
        members = [pixel for pixel, own in object_of.items() if own == object_id]
        slow.append(may_be_slow[object_id] and not any(motion) and is_biased(sweeps, members))
    every = centroids(points_of_objects(sweeps, object_of, slow, sweeps.size, NUM_LAYERS), sweeps)
    result = [(x * sweeps.size, y * sweeps.size) for y, x in motions]
    for object_id in [object_id for object_id, is_slow in enumerate(slow) if is_slow]:
        cubes = [cube_of(every, voxel, sweeps) for voxel in every.values() if voxel.object_id == object_id]
        x, y = (shift / UNITS / sweeps.elapsed[1] for shift in significant_shift(cubes))
        result[object_id] = (x, y)
    return result


def is_biased(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """Whether an object matches more of the other sweep a pixel ahead than a pixel behind, or the reverse."""
    size = sum(count(sweeps.at(*pixel)) for pixel in members)
    for dy, dx in SIDES:
        a, b = 0, 0
        for m, r, c in members:
            direction = 1 if m == 1 else -1
            ahead = sweeps.at(m, r, c) & sweeps.at(1 - m, r + direction * dy, c + direction * dx)
            behind = sweeps.at(m, r, c) & sweeps.at(1 - m, r - direction * dy, c - direction * dx)
            a, b = a + count(ahead & ~behind), b + count(behind & ~ahead)
        if (a - b) ** 2 >= BIAS_Z**2 * (a + b) and abs(a - b) * LEAST_BIAS >= size > 0:
            return True
    return False


def cube_of(every: Voxels, voxel: Voxel, sweeps: SlicedSweeps) -> Cube:
    """What a cube of an object may meet: the cubes of the other sweep, in its layer, in the 5 x 5 pixels around it."""
    sign = 1 if voxel.step == 1 else -1
    near = around(every, 1 - voxel.step, voxel.layer, voxel.x, voxel.y, sweeps, AROUND)
    return np.array([(sign * (other.x - voxel.x), sign * (other.y - voxel.y)) for other in near]).reshape(-1, 2)


def significant_shift(cubes: Sequence[Cube]) -> tuple[int, int]:
    """The shift (x, y) to which a few steps lead from rest, 0 if it is not significant.

    A step goes twice as far as cubes miss what they meet, on average, by the weights of the meetings.
    """
    x = y = 0
    at_rest = met = [meet(cube, x, y) for cube in cubes]
    for _ in range(NUM_STEPS):
        total = max(sum(weight for weight, _, _ in met), 1 / 256)
        x = clamped(x + whole(STEP_LENGTH * (sum(weight * dx for weight, dx, _ in met) / total)))
        y = clamped(y + whole(STEP_LENGTH * (sum(weight * dy for weight, _, dy in met) / total)))
        met = [meet(cube, x, y) for cube in cubes]
    gains = [now[0] - before[0] for now, before in zip(met, at_rest)]
    is_significant = sum(gains) > Z * math.sqrt(sum(gain * gain for gain in gains))
    is_much = sum(gains) >= LEAST_GAIN * len(cubes) and len(cubes) >= LEAST_CUBES
    return (x, y) if is_significant and is_much else (0, 0)


def meet(cube: Cube, x: int, y: int) -> tuple[float, int, int]:
    """Weight of what a cube meets under a shift, 1 at most, and by how much it misses it.

    Ties: the first in raster order.
    """
    offsets = [(dx - x, dy - y) for dx, dy in cube.tolist()]
    if not offsets:
        return 0.0, 0, 0
    dx, dy = min(offsets, key=lambda offset: offset[0] ** 2 + offset[1] ** 2)
    return meeting_weight(dx * dx + dy * dy, SIGMA), dx, dy


def clamped(shift: int) -> int:
    return max(-FARTHEST, min(shift, FARTHEST))
