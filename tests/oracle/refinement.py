"""Refinement of the motion of groups: a few Gauss-Newton steps on the centroids of their voxels (docs/beyond.md).

All groups move rigidly: about a centre by an angle, and on by a translation, both in proportion to the time that
passes. Lengths are integers, 1/1024 m from the lower corner of the region; the turn is the tangent of half the angle.
"""

from __future__ import annotations

import math
from typing import Dict, List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import Config
from oracle.pixels import project_bev
from oracle.sweeps import Cloud

UNITS = 1024  # of a metre
SIGMA = 0.15  # metres, of the weight of a pair of voxels
MOST_TIME = 2.5  # sweep intervals: older sweeps are not looked at
NUM_STEPS = 4
LONGEST_WAY = 0.15  # metres per interval, in x and in y, from the given flow
LARGEST_TURN = 0.1  # tangent of half the angle per interval
HELD = 150.0  # perfect pairs of voxels that the given translation is worth
HELD_SHARE = 0.2  # and, besides, this share of the pairs that were found
HELD_TURN = 20.0  # perfect pairs at a distance of 1 m that no turn is worth


class Point(NamedTuple):
    """A point of a group: sweep, height slice 0 ... 3, group, place in metres (frame of t+1)."""

    window: int
    step: int
    part: int
    group: int
    x: float
    y: float


def points_of_groups(
    wanted: Sequence[bool],
    group_of: Dict[Tuple[int, int, int], int],
    sweeps: Sequence[Cloud],
    inside: Sequence[np.ndarray],
    slices: Tuple[float, int],
    config: Config,
) -> List[Point]:
    """Points of some groups.

    Args:
        wanted: of each group.
        group_of: (sweep, row, col) -> group.
        sweeps: t+1, t, t-1, ...
        inside: of each sweep, the points that count.
        slices: height of a slice in metres, and how many are told apart.
        config: for the finest pixels.
    """
    height, num_slices = slices
    points = []
    for m, (cloud, keep) in enumerate(zip(sweeps, inside)):
        kept = cloud.points[keep]
        for (r, c), (x, y, z) in zip(project_bev(kept, config, config.pixel_sizes[-1]).tolist(), kept.tolist()):
            group = group_of.get((m, r, c), -1)
            if group >= 0 and wanted[group]:
                points.append(Point(0, m, math.floor(z / height) % num_slices, group, x, y))
    return points


class Voxel(NamedTuple):
    """Where in the images (window, step, row, col, part) some points lie, and their centroid in units."""

    window: int
    step: int
    part: int
    group: int
    x: int
    y: int


class Rigid(NamedTuple):
    """Motion per sweep interval: (x, y) of the flow at the centre, turn, centre; metres."""

    flow: Tuple[float, float]
    turn: float
    centre: Tuple[float, float]


class Pair(NamedTuple):
    """A voxel of an earlier sweep and one of t+1: time between, turned lever of the first, what is missing, weight."""

    time: float
    lever: Tuple[int, int]
    error: Tuple[int, int]
    weight: int


Place = Tuple[int, int, int, int, int]  # window, step, row, col, part


def refine(
    points: Sequence[Point],
    flow: Sequence[Tuple[float, float]],
    elapsed: Sequence[Sequence[float]],
    lower: Tuple[float, float],
    pixel_size: float,
    turns: bool = True,
) -> List[Rigid]:
    """Refine the motion of every group.

    Args:
        points: of all groups, all sweeps; the points of a pixel have one group.
        flow: of each group, (x, y) metres per sweep interval, to start from.
        elapsed: of each window, intervals from each sweep to t+1.
        lower: lower corner of the region, metres.
        pixel_size: metres.
        turns: False = the groups do not turn.

    Returns:
        Of each group. A group without points at t keeps its flow; its centre is the lower corner.

    Convention:
        Of the start and the `NUM_STEPS` steps that follow, the one whose pairs weigh most counts, of equals the first.
    """
    voxels = centroids(points, lower, pixel_size)
    result = []
    for group, start in enumerate(flow):
        members = [voxel for voxel in voxels.values() if voxel.group == group]
        at_t = [voxel for voxel in members if voxel.step == 1]
        if not at_t:
            result.append(Rigid((float(start[0]), float(start[1])), 0.0, (float(lower[0]), float(lower[1]))))
            continue
        centre = (sum(v.x for v in at_t) // len(at_t), sum(v.y for v in at_t) // len(at_t))
        given = (start[0] * UNITS, start[1] * UNITS)
        way, turn = given, 0.0
        best_way, best_turn, most = way, turn, -1
        for step in range(NUM_STEPS + 1):
            found = pairs(members, voxels, elapsed, centre, way, turn, pixel_size)
            score = sum(pair.weight for pair in found)
            if score > most:
                best_way, best_turn, most = way, turn, score
            if step < NUM_STEPS:
                dx, dy, angle = gauss_newton(found, given, way, turn, turns)
                way = (limit(way[0] + dx, given[0]), limit(way[1] + dy, given[1]))
                turn = min(max(turn + angle / 2, -LARGEST_TURN), LARGEST_TURN)
        flow_x, flow_y = best_way[0] / UNITS, best_way[1] / UNITS
        result.append(Rigid((flow_x, flow_y), best_turn, (centre[0] / UNITS + lower[0], centre[1] / UNITS + lower[1])))
    return result


def centroids(points: Sequence[Point], lower: Tuple[float, float], pixel_size: float) -> Dict[Place, Voxel]:
    """Voxels (pixel and height slice of a sweep) that hold points: mean of their places, rounded down to units."""
    sums: Dict[Place, List[int]] = {}
    for p in points:
        row, col = math.floor((p.y - lower[1]) / pixel_size), math.floor((p.x - lower[0]) / pixel_size)
        total = sums.setdefault((p.window, p.step, row, col, p.part), [0, 0, 0, p.group])
        total[0] += math.floor((p.x - lower[0]) * UNITS + 0.5)
        total[1] += math.floor((p.y - lower[1]) * UNITS + 0.5)
        total[2] += 1
    return {
        place: Voxel(place[0], place[1], place[4], group, x // count, y // count)
        for place, (x, y, count, group) in sums.items()
    }


def pairs(
    members: Sequence[Voxel],
    voxels: Dict[Place, Voxel],
    elapsed: Sequence[Sequence[float]],
    centre: Tuple[int, int],
    way: Tuple[float, float],
    turn: float,
    pixel_size: float,
) -> List[Pair]:
    """Voxels of a group that find each other under its motion, looked for from both ends.

    Every voxel before t+1 looks for the nearest one at t+1, every voxel of t+1 for the nearest one in each earlier
    sweep. If what is nearest belongs to another group there is no pair; two that choose each other count twice.
    """
    found = []
    for voxel in members:
        for step, time in enumerate(elapsed[voxel.window]):
            if not 0 < time <= MOST_TIME:
                continue
            if voxel.step == 0:  # back to sweep `step`
                x, y = voxel.x - centre[0] - time * way[0], voxel.y - centre[1] - time * way[1]
                x, y = rotate(-turn * time, x, y)
                x, y = math.floor(x + centre[0] + 0.5), math.floor(y + centre[1] + 0.5)
                partner = nearest(voxels, voxel.window, step, voxel.part, x, y, pixel_size)
            elif voxel.step == step:  # on to t+1
                x, y = moved(voxel, centre, way, turn, time)
                partner = nearest(voxels, voxel.window, 0, voxel.part, x, y, pixel_size)
            else:
                continue
            if partner is None or partner.group != voxel.group:
                continue
            earlier, later = (partner, voxel) if voxel.step == 0 else (voxel, partner)
            x, y = moved(earlier, centre, way, turn, time)
            error = (later.x - x, later.y - y)
            r_x, r_y = rotate(turn * time, earlier.x - centre[0], earlier.y - centre[1])
            lever = (math.floor(r_x + 0.5), math.floor(r_y + 0.5))
            found.append(Pair(time, lever, error, weight(error[0] * error[0] + error[1] * error[1])))
    return found


def moved(voxel: Voxel, centre: Tuple[int, int], way: Tuple[float, float], turn: float, time: float) -> Tuple[int, int]:
    """Where a voxel is `time` intervals later, in whole units."""
    x, y = rotate(turn * time, voxel.x - centre[0], voxel.y - centre[1])
    x, y = x + centre[0] + time * way[0], y + centre[1] + time * way[1]
    return math.floor(x + 0.5), math.floor(y + 0.5)


def rotate(turn: float, x: float, y: float) -> Tuple[float, float]:
    """Rotate by the angle whose half has the tangent `turn`."""
    n = 1 + turn * turn
    cos, sin = (1 - turn * turn) / n, 2 * turn / n
    return cos * x - sin * y, sin * x + cos * y


def nearest(
    voxels: Dict[Place, Voxel], window: int, step: int, part: int, x: int, y: int, pixel_size: float
) -> Optional[Voxel]:
    """Nearest voxel of a sweep and slice in the 3 x 3 pixels around a place; of equals the first in raster order."""
    side = pixel_size * UNITS
    row, col = math.floor(y / side), math.floor(x / side)
    best, least = None, 0
    for r in (row - 1, row, row + 1):
        for c in (col - 1, col, col + 1):
            voxel = voxels.get((window, step, r, c, part))
            if voxel is None:
                continue
            distance = (voxel.x - x) ** 2 + (voxel.y - y) ** 2
            if best is None or distance < least:
                best, least = voxel, distance
    return best


def weight(distance2: int) -> int:
    """256 exp(-d^2 / 2 sigma^2), d^2 in steps of 64 square units of which 2048 count."""
    step = distance2 // 64
    if step >= 2048:
        return 0
    return int(256 * math.exp(-(64 * step + 32) / (2 * (SIGMA * UNITS) ** 2)) + 0.5)


def gauss_newton(
    found: Sequence[Pair], given: Tuple[float, float], way: Tuple[float, float], turn: float, turns: bool
) -> Tuple[float, float, float]:
    """Least squares: change of the translation (units) and of the angle (radians, small), per interval.

    Minimises, over the pairs with times k, levers r and errors e,
    sum w (k (dx - r_y a) - e_x)^2 + w (k (dy + r_x a) - e_y)^2, and the squares that hold on to the given translation
    and to no turn. Sums of integers with times in 1/16 intervals; then one expression of float64 in the written order.
    """
    s, s_x, s_y, s_xy, e_x, e_y, e_a = 0, 0, 0, 0, 0, 0, 0
    for pair in found:
        k, (r_x, r_y), (x, y) = math.floor(pair.time * 16 + 0.5), pair.lever, pair.error
        s += pair.weight * k * k
        s_x += pair.weight * k * k * r_x
        s_y += pair.weight * k * k * r_y
        s_xy += pair.weight * k * k * (r_x * r_x + r_y * r_y)
        e_x += pair.weight * k * x
        e_y += pair.weight * k * y
        e_a += pair.weight * k * (r_x * y - r_y * x)
    held = HELD * 256 + HELD_SHARE * (s / 256)
    held_turn = HELD_TURN * 256 * UNITS * UNITS
    a, a_x, a_y, a_xy = s / 256 + held, s_x / 256, -s_y / 256, s_xy / 256 + held_turn
    b_x, b_y = e_x / 16 + held * (given[0] - way[0]), e_y / 16 + held * (given[1] - way[1])
    b_a = e_a / 16 - held_turn * (2 * turn)
    angle = 0.0
    if turns:
        angle = (b_a - (a_y * b_x + a_x * b_y) / a) / (a_xy - (a_y * a_y + a_x * a_x) / a)
    return (b_x - a_y * angle) / a, (b_y - a_x * angle) / a, angle


def limit(value: float, given: float) -> float:
    """At most `LONGEST_WAY` from the given one."""
    return min(max(value, given - LONGEST_WAY * UNITS), given + LONGEST_WAY * UNITS)
