"""Rigid registration: a few Gauss-Newton steps on the voxel centroids of objects; de-skewing.

An object turns about a centre and moves on, both in proportion to the time that passes. Lengths are units of 1/1024 m
from the lower corner of the region; the turn is the tangent of half the angle.
"""

from __future__ import annotations

from typing import NamedTuple, Sequence

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import SlicedSweeps, Vector
from oracle.voxels import UNITS, Point, Voxel, Voxels, centroids, meeting_weight, nearest, whole

LAYER_HEIGHT, NUM_LAYERS = 0.1, 16  # of voxels, metres; their number, then they repeat
SIGMA = 0.12  # metres, of the weight of a pair of voxels
MOST_TIME = 2.5  # sweep intervals: older sweeps are not looked at
NUM_STEPS, STEP_LENGTH = 5, 1.6  # steps, as long as so many of Gauss and Newton
LONGEST_WAY = 0.15 * UNITS  # per interval, in x and in y, from the given flow
LARGEST_TURN = 0.1  # tangent of half the angle per interval
HELD = 40.0  # perfect pairs that the given translation is worth
HELD_TURN = 20.0  # perfect pairs at a distance of 1 m that no turn is worth
LEAST_STRETCH = 0.75  # where the time between points is a smaller share of that between sweeps, it is not believed


class RigidMotion(NamedTuple):
    """Motion per sweep interval: (x, y) of the flow at the centre, turn, centre; metres."""

    flow: Vector
    rotation: float
    centre: Vector

    def flow_at(self, x: float, y: float) -> Vector:
        """Flow of a point of t, by its place; all in metres."""
        arm_x, arm_y = x - self.centre[0], y - self.centre[1]
        turned_x, turned_y = rotate(self.rotation, arm_x, arm_y)
        return (turned_x - arm_x) + self.flow[0], (turned_y - arm_y) + self.flow[1]


class Pair(NamedTuple):
    """A voxel and the one that it finds in another sweep: time from one to the other, in whole 1/16; turned arm of the
    first, what is missing, weight; how much longer than between the sweeps it is between the points, in intervals."""

    time: float
    arm: tuple[int, int]
    error: tuple[int, int]
    weight: float
    late: float


def register(points: Sequence[Point], flow: Sequence[Vector], sweeps: SlicedSweeps) -> list[RigidMotion]:
    """Refine the motion of every object, from (x, y) metres per interval. One without points at t keeps its flow."""
    voxels, lower = centroids(points, sweeps), sweeps.lower
    result = []
    for owner, start in enumerate(flow):
        members = [voxel for voxel in voxels.values() if voxel.owner == owner]
        at_t = [voxel for voxel in members if voxel.step == 1]
        if not at_t:
            result.append(RigidMotion(start, 0.0, lower))
            continue
        centre = (sum(v.x for v in at_t) // len(at_t), sum(v.y for v in at_t) // len(at_t))
        given = (start[0] * UNITS, start[1] * UNITS)
        way, turn = given, 0.0
        for _ in range(NUM_STEPS):
            found = find_pairs(members, voxels, sweeps, centre, way, turn)
            dx, dy, angle = (STEP_LENGTH * change for change in gauss_newton(found, given, way, turn))
            way = (limit(way[0] + dx, given[0], LONGEST_WAY), limit(way[1] + dy, given[1], LONGEST_WAY))
            turn = limit(turn + angle / 2, 0.0, LARGEST_TURN)
        corner = (centre[0] / UNITS + lower[0], centre[1] / UNITS + lower[1])
        result.append(RigidMotion((way[0] / UNITS, way[1] / UNITS), turn, corner))
    return result


def find_pairs(
    members: Sequence[Voxel], voxels: Voxels, sweeps: SlicedSweeps, centre: tuple[int, int], way: Vector, turn: float
) -> list[Pair]:
    """Voxels of an object that find each other under its motion, looked for from both ends.

    Every voxel of another sweep looks for the nearest one at t+1, every voxel of t+1 for the nearest one in each other
    sweep. If what is nearest belongs to another object there is no pair; two that choose each other count twice.
    """
    found = []
    for voxel in members:
        others = range(1, len(sweeps.elapsed)) if voxel.step == 0 else [0]
        for step in others:
            start, end = (sweeps.elapsed[1] - sweeps.elapsed[m] for m in (voxel.step, step))  # intervals since t
            if abs(end - start) > MOST_TIME:
                continue
            # The centre is that of t; it moves on, and the voxel turns about it.
            arm_x, arm_y = voxel.x - centre[0] - way[0] * start, voxel.y - centre[1] - way[1] * start
            arm_x, arm_y = rotate(turn * (end - start), arm_x, arm_y)
            x, y = whole(centre[0] + way[0] * end + arm_x), whole(centre[1] + way[1] * end + arm_y)
            partner = nearest(voxels, step, voxel.part, x, y, sweeps)
            if partner is None or partner.owner != voxel.owner:
                continue
            error = (partner.x - x, partner.y - y)
            weight = meeting_weight(error[0] ** 2 + error[1] ** 2, SIGMA)
            late = whole((partner.time - voxel.time) * UNITS) / UNITS
            found.append(Pair(whole((end - start) * 16) / 16, (whole(arm_x), whole(arm_y)), error, weight, late))
    return found


def rotate(turn: float, x: float, y: float) -> Vector:
    """Rotate by the angle whose half has the tangent `turn`."""
    n = 1 + turn * turn
    cos, sin = (1 - turn * turn) / n, 2 * turn / n
    return cos * x - sin * y, sin * x + cos * y


def gauss_newton(found: Sequence[Pair], given: Vector, way: Vector, turn: float) -> tuple[float, float, float]:
    """Least squares: change of the translation (units) and of the angle (radians, small), per interval.

    Minimises, over the pairs with times k, arms r and errors e, sum w (k (dx - r_y a) - e_x)^2 +
    w (k (dy + r_x a) - e_y)^2, and the squares that hold on to the given translation and to no turn.
    """
    s = s_x = s_y = s_xy = e_x = e_y = e_a = 0.0
    for k, (r_x, r_y), (x, y), w, _ in found:
        s += w * k * k
        s_x += w * k * k * r_x
        s_y += w * k * k * r_y
        s_xy += w * k * k * (r_x * r_x + r_y * r_y)
        e_x += w * k * x
        e_y += w * k * y
        e_a += w * k * (r_x * y - r_y * x)
    held_turn = HELD_TURN * UNITS**2
    a, a_x, a_y, a_xy = s + HELD, s_x, -s_y, s_xy + held_turn
    b_x, b_y = e_x + HELD * (given[0] - way[0]), e_y + HELD * (given[1] - way[1])
    b_a = e_a - held_turn * (2 * turn)
    angle = (b_a - (a_y * b_x + a_x * b_y) / a) / (a_xy - (a_y * a_y + a_x * a_x) / a)
    return (b_x - a_y * angle) / a, (b_y - a_x * angle) / a, angle


def limit(value: float, middle: float, most: float) -> float:
    """At most `most` from the middle."""
    return min(max(value, middle - most), middle + most)


def register_deskewed(
    points: Sequence[Point],
    start: Sequence[Vector],
    seen: Sequence[RigidMotion],
    sweeps: SlicedSweeps,
    config: VerifiedConfig,
) -> list[RigidMotion]:
    """The motion of every object per interval: `seen`, which `register` found from `start`, divided by how much longer
    the time between its points is than that between the sweeps; with more than two sweeps registered once more."""
    stretch = stretch_of(points, seen, sweeps)
    divided = [m._replace(flow=(m.flow[0] / s, m.flow[1] / s)) for m, s in zip(seen, stretch)]
    if len(sweeps.images) == 2:
        return divided
    sharp = deskew(points, divided, sweeps, config)
    again = register(sharp, [(x / s, y / s) for (x, y), s in zip(start, stretch)], sweeps)
    present = {point.owner for point in points}
    return [again[owner] if owner in present else motion for owner, motion in enumerate(divided)]


def stretch_of(points: Sequence[Point], seen: Sequence[RigidMotion], sweeps: SlicedSweeps) -> list[float]:
    """Of each object: sum of w k (k + late) over the sum of w k^2, over its pairs of voxels; 1 without any."""
    voxels, (x0, y0) = centroids(points, sweeps), sweeps.lower
    result = []
    for owner, motion in enumerate(seen):
        members = [voxel for voxel in voxels.values() if voxel.owner == owner]
        members = members if any(voxel.step == 1 for voxel in members) else []
        centre = (round((motion.centre[0] - x0) * UNITS), round((motion.centre[1] - y0) * UNITS))
        way = (motion.flow[0] * UNITS, motion.flow[1] * UNITS)
        total = late = 0.0
        for k, _, _, weight, of_pair in find_pairs(members, voxels, sweeps, centre, way, motion.rotation):
            total, late = total + weight * k * k, late + weight * k * of_pair
        stretch = 1 + late / total if total > 0 else 1.0
        result.append(stretch if stretch >= LEAST_STRETCH else 1.0)
    return result


def deskew(
    points: Sequence[Point], motions: Sequence[RigidMotion], sweeps: SlicedSweeps, config: VerifiedConfig
) -> list[Point]:
    """Points where they were at the instant of their sweep; of those in one pixel, those of the first object."""
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    moved, owner_of = [], {}  # type: ignore[var-annotated]
    for point in points:
        (f_x, f_y), turn, (c_x, c_y) = motions[point.owner]
        since_t = sweeps.elapsed[1] - sweeps.elapsed[point.step]
        x, y = point.x - f_x * point.time, point.y - f_y * point.time
        arm_x, arm_y = x - c_x - f_x * since_t, y - c_y - f_y * since_t
        turned_x, turned_y = rotate(-point.time * turn, arm_x, arm_y)
        x, y = x + (turned_x - arm_x), y + (turned_y - arm_y)
        if x0 <= x <= x1 and y0 <= y <= y1:
            pixel = (point.step, *sweeps.pixel(x, y))
            owner_of[pixel] = min(owner_of.get(pixel, point.owner), point.owner)
            moved.append((pixel, point._replace(x=x, y=y)))
    return [point for pixel, point in moved if owner_of[pixel] == point.owner]
