"""Sub-pixel motion of pairs: slow objects, found by how well the centroids of small cubes meet."""

from __future__ import annotations

import math
from itertools import product
from typing import Sequence

from oracle.height_slices import Pixel, SlicedSweeps, Vector, count
from oracle.voxels import UNITS, Voxel, Voxels, centre_pixel, voxels_of

SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
BIAS_Z, LEAST_BIAS = 3, 10  # standard deviations of noise of a bias; and it must be a 10th of the object's slices
NUM_LAYERS = 16  # layers of cubes are told apart by this many numbers, then they repeat
SIGMA = 0.07  # metres, of the weight of two centroids
NUM_STEPS, STEP_LENGTH, FARTHEST = 4, 2, 154  # steps to the best shift, their length, its largest side in units
Z, LEAST_GAIN, LEAST_CUBES = 4.0, 0.05, 6  # significance; gain per cube, as a share of a perfect meeting; cubes
AROUND = 2  # pixels in which a cube meets others


def subpixel_motion(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], motions: Sequence[Vector], may_be_slow: Sequence[bool]
) -> list[Vector]:
    """The motion of the objects of a pair, (x, y) metres per interval, from (y, x) pixels per interval, 0 = static; the
    moving ones keep their motion."""
    slow = []
    for object_id, motion in enumerate(motions):
        members = [pixel for pixel, own in object_of.items() if own == object_id]
        slow.append(may_be_slow[object_id] and not any(motion) and is_biased(sweeps, members))
    every = voxels_of(sweeps, object_of, slow, sweeps.size, NUM_LAYERS)
    result = [(x * sweeps.size, y * sweeps.size) for y, x in motions]
    for object_id in [object_id for object_id, is_slow in enumerate(slow) if is_slow]:
        cubes = [others_around(every, voxel, sweeps) for voxel in every.values() if voxel.object_id == object_id]
        x, y = significant_shift(cubes)
        result[object_id] = (x / UNITS / sweeps.elapsed[1], y / UNITS / sweeps.elapsed[1])
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


def others_around(every: Voxels, voxel: Voxel, sweeps: SlicedSweeps) -> list[tuple[int, int]]:
    """What a cube of an object may meet: the cubes of the other sweep in its layer, in the 5 x 5 pixels around it, in
    raster order, as offsets from t to t+1."""
    sign, (row, col) = 1 if voxel.step == 1 else -1, centre_pixel(voxel.x, voxel.y, sweeps, AROUND)
    near = [(1 - voxel.step, row + dy, col + dx, voxel.layer) for dy, dx in product(range(-2, 3), repeat=2)]
    others = [every[index] for index in near if index in every]
    return [(sign * (other.x - voxel.x), sign * (other.y - voxel.y)) for other in others]


def significant_shift(cubes: Sequence[Sequence[tuple[int, int]]]) -> tuple[int, int]:
    """The shift (x, y) to which a few steps lead from rest, 0 if it is not significant.

    A step goes twice as far as cubes miss what they meet, on average, by the weights of the meetings.
    """
    x = y = 0
    at_rest = met = [meet(cube, x, y) for cube in cubes]
    for _ in range(NUM_STEPS):
        total = max(sum(weight for weight, _, _ in met), 1 / 256)
        x += round(STEP_LENGTH * (sum(weight * dx for weight, dx, _ in met) / total))
        y += round(STEP_LENGTH * (sum(weight * dy for weight, _, dy in met) / total))
        x, y = (max(-FARTHEST, min(shift, FARTHEST)) for shift in (x, y))
        met = [meet(cube, x, y) for cube in cubes]
    gains = [now[0] - before[0] for now, before in zip(met, at_rest)]
    is_significant = sum(gains) > Z * math.sqrt(sum(gain * gain for gain in gains))
    is_much = sum(gains) >= LEAST_GAIN * len(cubes) and len(cubes) >= LEAST_CUBES
    return (x, y) if is_significant and is_much else (0, 0)


def meet(cube: Sequence[tuple[int, int]], x: int, y: int) -> tuple[float, int, int]:
    """Weight of what a cube meets under a shift, and by how much it misses it. Ties: the first in raster order.

    The weight is exp(-d^2 / 2 sigma^2), in 256ths, of d^2 in steps of 64 square units of which 2048 count.
    """
    offsets = [(dx - x, dy - y) for dx, dy in cube]
    if not offsets:
        return 0.0, 0, 0
    dx, dy = min(offsets, key=lambda offset: offset[0] ** 2 + offset[1] ** 2)
    step = (dx * dx + dy * dy) // 64
    weight = round(256 * math.exp(-(64 * step + 32) / (2 * (SIGMA * UNITS) ** 2))) / 256 if step < 2048 else 0.0
    return weight, dx, dy
