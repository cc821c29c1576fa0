"""Slow groups: motion of a pixel or less, proved on the centroids of small cubes (docs/beyond.md)."""

from __future__ import annotations

import math
from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import Config
from oracle.refinement import UNITS, Place, Point, Voxel, centroids, points_of_groups
from oracle.sweeps import Cloud

SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
LEAN_Z = 3  # standard deviations of luck for a lean
LEAST_LEAN = 10  # and it must be a 10th of the group's slices
NUM_LAYERS = 16  # cubes are told apart by this many layers as high as a pixel is wide, then they repeat
SIGMA = 0.07  # metres, of the weight of two centroids
STEP = 51  # units between shifts that are judged
REACH = 3  # steps
Z = 4.0  # standard deviations of luck that a shift is granted
LEAST_GAIN = 2  # 40ths of a perfect meeting that a shift must gain per cube
LEAST_CUBES = 6
BLOCK = 410  # units, side of the blocks that vote
AROUND = 2  # pixels in which a cube looks for others

Pixel = Tuple[int, int, int]  # sweep, row, col


def creep(
    asked: Sequence[bool],
    group_of: Dict[Pixel, int],
    images: Sequence[np.ndarray],
    sweeps: Sequence[Cloud],
    inside: Sequence[np.ndarray],
    config: Config,
) -> List[Optional[Tuple[float, float]]]:
    """(x, y) metres per sweep interval of each group that moves slowly, None of the others.

    Args:
        asked: of each group, whether it is looked at.
        group_of: (sweep, row, col) -> group.
        images: (H, W) uint8 of both sweeps; bits are slices.
        sweeps: t+1 and t.
        inside: of each sweep, the points that count.
        config: settings.
    """
    members: List[List[Pixel]] = [[] for _ in asked]
    for pixel, group in group_of.items():
        members[group].append(pixel)
    wanted = [is_asked and leans(images, pixels) for is_asked, pixels in zip(asked, members)]
    size, (x0, y0) = config.pixel_sizes[-1], config.point_cloud_range[:2]
    points = points_of_groups(wanted, group_of, sweeps, inside, (size, NUM_LAYERS), config)
    return slow_motion(points, len(asked), sweeps[1].steps, (x0, y0), size)


def leans(images: Sequence[np.ndarray], members: Sequence[Pixel]) -> bool:
    """Whether a group meets more of the other sweep a pixel ahead than a pixel behind, or the other way round.

    Args:
        images: (H, W) uint8 of sweep t+1 and of t; bits are slices.
        members: pixels of the group.
    """
    size = sum(bin(int(images[m][r, c])).count("1") for m, r, c in members)
    for dy, dx in SIDES:
        a, b = 0, 0
        for m, r, c in members:
            way = 1 if m == 1 else -1
            ahead = int(images[m][r, c]) & _slices(images[1 - m], r + way * dy, c + way * dx)
            behind = int(images[m][r, c]) & _slices(images[1 - m], r - way * dy, c - way * dx)
            a += bin(ahead & ~behind).count("1")
            b += bin(behind & ~ahead).count("1")
        if (a - b) ** 2 >= LEAN_Z**2 * (a + b) and abs(a - b) * LEAST_LEAN >= size > 0:
            return True
    return False


def slow_motion(
    points: Sequence[Point], num_groups: int, interval: float, lower: Tuple[float, float], pixel_size: float
) -> List[Optional[Tuple[float, float]]]:
    """The motion of slow groups between t and t+1.

    Args:
        points: of the groups that lean, of both sweeps; `part` is the layer, 0 ... 15.
        num_groups: how many groups there are.
        interval: sweep intervals from t to t+1.
        lower: lower corner of the region, metres.
        pixel_size: metres.

    Returns:
        Of each group, (x, y) metres per sweep interval; None = no motion is proved.

    Convention: of equally proved shifts the first in raster order.
    """
    cubes = centroids(points, lower, pixel_size)
    result: List[Optional[Tuple[float, float]]] = [None] * num_groups
    judged = (REACH, STEP, Z, LEAST_GAIN, LEAST_CUBES)
    for group in range(num_groups):
        members = [cube for cube in cubes.values() if cube.group == group]
        best = best_shift(cubes, members, (0, 0), pixel_size, *judged)
        if best is not None:
            members = heed(cubes, members, best, pixel_size)
            best = best_shift(cubes, members, (0, 0), pixel_size, *judged)
        if best is None:
            continue
        x, y = best
        around = [neighbours(cubes, cube, (0, 0), pixel_size) for cube in members]
        beside = [(x, y), (x - STEP, y), (x + STEP, y), (x, y - STEP), (x, y + STEP)]
        middle, left, right, below, above = (sum(gains(members, around, (0, 0), shift)) for shift in beside)
        d_x, d_y = vertex(left, middle, right), vertex(below, middle, above)
        result[group] = ((x + d_x * STEP) / UNITS / interval + 0.0, (y + d_y * STEP) / UNITS / interval + 0.0)
    return result


def heed(cubes: Dict[Place, Voxel], members: Sequence[Voxel], shift: Tuple[int, int], pixel_size: float) -> List[Voxel]:
    """The cubes that lie in blocks that gain by a shift."""
    around = [neighbours(cubes, cube, (0, 0), pixel_size) for cube in members]
    total: Dict[Tuple[int, int], int] = {}
    for cube, gain in zip(members, gains(members, around, (0, 0), shift)):
        block = cube.y // BLOCK, cube.x // BLOCK
        total[block] = total.get(block, 0) + gain
    return [cube for cube in members if total[cube.y // BLOCK, cube.x // BLOCK] > 0]


def best_shift(
    cubes: Dict[Place, Voxel],
    members: Sequence[Voxel],
    start: Tuple[int, int],
    pixel_size: float,
    reach: int,
    step: int,
    z: float,
    least_gain: int,
    least_cubes: int,
) -> Optional[Tuple[int, int]]:
    """The shift (x, y), units, beyond `start` that is proved best; of equals the first in raster order; None = none."""
    if len(members) < least_cubes:
        return None
    around = [neighbours(cubes, cube, start, pixel_size) for cube in members]
    line = [step * i for i in range(-reach, reach + 1)]
    best, most = None, 0
    for shift in [(x, y) for y in line for x in line]:
        gain = gains(members, around, start, shift)
        worth = math.floor(16 * (sum(gain) - z * math.sqrt(sum(g * g for g in gain))))
        if worth > most and sum(gain) * 40 >= len(members) * 256 * least_gain:
            best, most = shift, worth
    return best


def gains(
    members: Sequence[Voxel], around: Sequence[Sequence[Voxel]], start: Tuple[int, int], shift: Tuple[int, int]
) -> List[int]:
    """Weight that each cube gains by a shift beyond the start."""
    end = start[0] + shift[0], start[1] + shift[1]
    return [meet(cube, near, end) - meet(cube, near, start) for cube, near in zip(members, around)]


def neighbours(cubes: Dict[Place, Voxel], cube: Voxel, start: Tuple[int, int], pixel_size: float) -> List[Voxel]:
    """Cubes of the other sweep in the 5 x 5 pixels around where a start takes a cube, in its layer."""
    side, way = pixel_size * UNITS, 1 if cube.step == 1 else -1
    row, col = math.floor((cube.y + way * start[1]) / side), math.floor((cube.x + way * start[0]) / side)
    reach = range(-AROUND, AROUND + 1)
    places = [(cube.window, 1 - cube.step, row + dy, col + dx, cube.part) for dy in reach for dx in reach]
    return [cubes[place] for place in places if place in cubes]


def meet(cube: Voxel, near: Sequence[Voxel], shift: Tuple[int, int]) -> int:
    """Weight, 256 at most, of what a cube meets at a shift from t to t+1; that of t+1 is moved back."""
    way = 1 if cube.step == 1 else -1
    x, y = cube.x + way * shift[0], cube.y + way * shift[1]
    step = min((((other.x - x) ** 2 + (other.y - y) ** 2) // 64 for other in near), default=2048)
    return 0 if step >= 2048 else int(256 * math.exp(-(64 * step + 32) / (2 * (SIGMA * UNITS) ** 2)) + 0.5)


def vertex(low: int, middle: int, high: int) -> float:
    """Where the parabola through three gains, one step apart, is largest; at most half a step away."""
    curve = 2 * middle - low - high
    return min(max((high - low) / (2 * curve), -0.5), 0.5) if curve > 0 else 0.0


def _slices(image: np.ndarray, row: int, col: int) -> int:
    inside = 0 <= row < image.shape[0] and 0 <= col < image.shape[1]
    return int(image[row, col]) if inside else 0
