"""Rigid registration: a few Gauss-Newton steps on the voxels of objects, surface to surface; de-skewing.

An object rotates about a centre and moves on, both in proportion to the time that passes. Voxels are in units of
1/1024 m from the lower corner of the region; the rotation is the tangent of half the angle.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple, Sequence

import numpy as np

from oracle.height_slices import Pixel, SlicedSweeps, SweepPoint, Vector
from oracle.voxels import LAYERS, UNITS, Voxel, Voxels, nearest, voxels_of

LAYER_HEIGHT, NUM_LAYERS = 0.1, LAYERS  # of voxels, metres; their number, then they repeat
FARTHEST = 0.2  # metres, between the voxels of a pair
FAR = 3.0  # squared distance of a pair, in standard deviations of both surfaces, at which its weight is a quarter
NOISE = 0.05  # metres, standard deviation of a centroid across its surface
UNKNOWN = 0.2  # metres, standard deviation of a surface of fewer than three voxels
MOST_TIME = 2.5  # sweep intervals: older sweeps are ignored
NUM_STEPS, STEP_LENGTH = 4, 1.4  # steps, as long as so many of Gauss and Newton
LONGEST_CORRECTION = 0.15  # metres per interval, in x and in y, from the given flow
LARGEST_ROTATION = 0.1  # tangent of half the angle per interval
HELD, HELD_ROTATION = 2.0, 5.0  # pairs that the given translation is worth, and, at 1 m, no rotation
LEAST_STRETCH = 0.75  # where the time between points is a smaller share of that between sweeps, it is ignored


class RigidMotion(NamedTuple):
    """Motion per sweep interval: (x, y) of the flow at the centre, rotation, centre; metres."""

    flow: Vector
    rotation: float
    centre: Vector

    def flow_at(self, x: float, y: float) -> Vector:
        """Flow of a point of t, by its position; all in metres."""
        arm_x, arm_y = x - self.centre[0], y - self.centre[1]
        turned_x, turned_y = rotate(self.rotation, arm_x, arm_y)
        return (turned_x - arm_x) + self.flow[0], (turned_y - arm_y) + self.flow[1]


class Pair(NamedTuple):
    """A voxel and the nearest one at t+1: time from one to the other, in whole 1/16; rotated arm of the first and
    error, metres; (3, 3) weight; how much longer than between the sweeps it is between the points, in intervals."""

    time: float
    arm: Vector
    error: np.ndarray
    weight: np.ndarray
    late: float


class Surfaces:
    """Voxels of the moving objects of the sweeps that are not far in time from t+1, and their covariances."""

    def __init__(self, sweeps: SlicedSweeps, object_of: dict[Pixel, int], flow: Sequence[Vector]) -> None:
        near = {pixel: own for pixel, own in object_of.items() if abs(sweeps.elapsed[pixel[0]]) <= MOST_TIME}
        self.voxels = voxels_of(sweeps, near, [any(of_object) for of_object in flow], LAYER_HEIGHT, NUM_LAYERS)
        self.sweeps, self.spreads = sweeps, spread_of(self.voxels, sweeps)

    def at_t(self, object_id: int) -> list[Voxel]:
        return [voxel for voxel in self.voxels.values() if voxel.object_id == object_id and voxel.step == 1]

    def pairs(self, object_id: int, centre: tuple[int, int], velocity: Vector, rotation: float) -> list[Pair]:
        """Voxels of an object and the nearest ones at t+1 under its motion, metres per interval. If the nearest one is
        far, or of another object, there is no pair."""
        found = []
        v_x, v_y = velocity[0] * UNITS, velocity[1] * UNITS
        for voxel in self.voxels.values():
            if voxel.object_id != object_id or voxel.step == 0:
                continue
            # Intervals from t to t+1, and from the voxel to t+1. The centre is that of t; it moves on, and the voxel
            # rotates about it.
            end, elapsed = self.sweeps.elapsed[1], self.sweeps.elapsed[voxel.step]
            start = end - elapsed
            arm = voxel.x - centre[0] - v_x * start, voxel.y - centre[1] - v_y * start
            arm_x, arm_y = rotate(rotation * elapsed, *arm)
            x, y = round(centre[0] + v_x * end + arm_x), round(centre[1] + v_y * end + arm_y)
            partner = nearest(self.voxels, 0, voxel.layer, x, y, voxel.z, self.sweeps)
            if partner is None or partner.object_id != object_id:
                continue
            error = np.array([partner.x - x, partner.y - y, partner.z - voxel.z])
            if (error**2).sum() > round((FARTHEST * UNITS) ** 2):
                continue
            error = error / UNITS
            inverse = np.linalg.inv(self.spreads[voxel] + self.spreads[partner] + NOISE**2 * np.eye(3))
            weight = (FAR / (FAR + error @ inverse @ error)) ** 2 * NOISE**2 * inverse
            weight = np.round(256 * weight) / 256
            late = round((partner.time - voxel.time) * UNITS) / UNITS
            found.append(
                Pair(round(elapsed * 16) / 16, (round(arm_x / 16) / 64, round(arm_y / 16) / 64), error, weight, late)
            )
        return found


def spread_of(voxels: Voxels, sweeps: SlicedSweeps) -> dict[Voxel, np.ndarray]:
    """(3, 3) covariance, square metres, of the centroids of an object and sweep in the 3 x 3 x 3 blocks around a voxel.

    Blocks are 2 voxels wide, or 4 if the centroids in the smaller ones lie nearly on a line. Centroids are whole 256ths
    of a metre.
    """
    spreads: dict[Voxel, np.ndarray] = {}
    for side in (2, 4):
        sizes = (sweeps.size * UNITS * side, sweeps.size * UNITS * side, LAYER_HEIGHT * UNITS * side)
        blocks = {v: tuple(math.floor(at / size) for at, size in zip(v[3:6], sizes)) for v in voxels.values()}
        inside: dict[tuple[int, ...], list[tuple[int, ...]]] = {}
        for v, block in blocks.items():
            inside.setdefault((v.step, v.object_id, *block), []).append((v.x // 4, v.y // 4, v.z // 4))
        for v, (c, r, h) in blocks.items():
            if v in spreads:
                continue
            around = [(v.step, v.object_id, c + x, r + y, h + z) for x, y, z in product((-1, 0, 1), repeat=3)]
            near = np.array([position for block in around for position in inside.get(block, [])])
            n, sums = len(near), near.sum(0)
            scaled = (n * near.T @ near - np.outer(sums, sums)).astype(float)
            if (n >= 3 and 3 * scaled.trace() ** 2 >= 5 * (scaled**2).sum()) or side == 4:
                spreads[v] = scaled / (256 * n) ** 2 + (n < 3) * UNKNOWN**2 * np.eye(3)
    return spreads


def rotate(rotation: float, x: float, y: float) -> Vector:
    """Rotate by the angle whose half has the tangent `rotation`."""
    n = 1 + rotation * rotation
    cos, sin = (1 - rotation * rotation) / n, 2 * rotation / n
    return cos * x - sin * y, sin * x + cos * y


def register(sweeps: SlicedSweeps, object_of: dict[Pixel, int], flow: Sequence[Vector]) -> list[RigidMotion]:
    """Refine the motion of every object, from (x, y) metres per interval. One without points at t keeps its flow."""
    surfaces, lower = Surfaces(sweeps, object_of, flow), sweeps.lower
    result = []
    for object_id, start in enumerate(flow):
        at_t = surfaces.at_t(object_id)
        if not at_t:
            result.append(RigidMotion(start, 0.0, lower))
            continue
        centre = (sum(v.x for v in at_t) // len(at_t), sum(v.y for v in at_t) // len(at_t))
        v_x, v_y, rotation = *start, 0.0
        for _ in range(NUM_STEPS):
            found = surfaces.pairs(object_id, centre, (v_x, v_y), rotation)
            dx, dy, angle = (STEP_LENGTH * change for change in gauss_newton(found, start, (v_x, v_y), rotation))
            v_x = limit(v_x + dx, start[0], LONGEST_CORRECTION)
            v_y = limit(v_y + dy, start[1], LONGEST_CORRECTION)
            rotation = limit(rotation + angle / 2, 0.0, LARGEST_ROTATION)
        corner = (centre[0] / UNITS + lower[0], centre[1] / UNITS + lower[1])
        result.append(RigidMotion((v_x, v_y), rotation, corner))
    return result


def gauss_newton(found: Sequence[Pair], given: Vector, velocity: Vector, rotation: float) -> np.ndarray:
    """Least squares: change of the translation (metres) and of the angle (radians, small), per interval.

    Minimises, over the pairs with times k and arms r, the squared errors that are left in x and y, each weighted, and
    the squares that hold on to the given translation and to no rotation.
    """
    matrix, force = np.diag([HELD, HELD, HELD_ROTATION]), np.zeros(3)
    force[:2] = HELD * (np.array(given) - velocity)
    force[2] = -HELD_ROTATION * 2 * rotation
    for k, (r_x, r_y), error, weight, _ in found:
        change = k * np.array([[1.0, 0.0, -r_y], [0.0, 1.0, r_x]])
        matrix += change.T @ weight[:2, :2] @ change
        force += change.T @ weight[:2] @ error
    return np.linalg.solve(matrix, force)


def limit(value: float, middle: float, most: float) -> float:
    """At most `most` from the middle."""
    return min(max(value, middle - most), middle + most)


# ------------------------------------------------------------------------------------------------ times of points


def register_deskewed(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], start: Sequence[Vector], seen: Sequence[RigidMotion]
) -> list[RigidMotion]:
    """The motion of every object per interval: `seen`, which `register` found from `start`, divided by how much longer
    the time between its points is than that between the sweeps; with more than two sweeps registered once more."""
    stretch = stretch_of(sweeps, object_of, seen)
    divided = [m._replace(flow=(m.flow[0] / s, m.flow[1] / s)) for m, s in zip(seen, stretch)]
    if len(sweeps.images) == 2:
        return divided
    sharp, sharp_object_of = deskew(sweeps, object_of, divided)
    return register(sharp, sharp_object_of, [(x / s, y / s) for (x, y), s in zip(start, stretch)])


def stretch_of(sweeps: SlicedSweeps, object_of: dict[Pixel, int], seen: Sequence[RigidMotion]) -> list[float]:
    """Of each object: sum of w k (k + late) over the sum of w k^2, over its pairs of voxels, with the weight in x plus
    that in y; 1 without any."""
    surfaces, (x0, y0) = Surfaces(sweeps, object_of, [motion.flow for motion in seen]), sweeps.lower
    result = []
    for object_id, motion in enumerate(seen):
        centre = (round((motion.centre[0] - x0) * UNITS), round((motion.centre[1] - y0) * UNITS))
        total = late = 0.0
        if surfaces.at_t(object_id):
            for pair in surfaces.pairs(object_id, centre, motion.flow, motion.rotation):
                weight = pair.weight[0, 0] + pair.weight[1, 1]
                total, late = total + weight * pair.time**2, late + weight * pair.time * pair.late
        stretch = 1 + late / total if total > 0 else 1.0
        result.append(stretch if stretch >= LEAST_STRETCH else 1.0)
    return result


def deskew(
    sweeps: SlicedSweeps, object_of: dict[Pixel, int], motions: Sequence[RigidMotion]
) -> tuple[SlicedSweeps, dict[Pixel, int]]:
    """Points of moving objects where they were at the instant of their sweep, and the objects of their pixels; of the
    points in one pixel, those of the first object."""
    x0, y0, _, x1, y1, _ = sweeps.config.point_cloud_range
    moved, sharp_object_of = [], {}  # type: ignore[var-annotated]
    for pixel, point in sweeps.points():
        number = object_of.get(pixel)
        if number is None or not any(motions[number].flow):
            continue
        (f_x, f_y), rotation, (c_x, c_y) = motions[number]
        since_t = sweeps.elapsed[1] - sweeps.elapsed[pixel[0]]
        x, y = point.x - f_x * point.time, point.y - f_y * point.time
        arm_x, arm_y = x - c_x - f_x * since_t, y - c_y - f_y * since_t
        turned_x, turned_y = rotate(-point.time * rotation, arm_x, arm_y)
        x, y = x + (turned_x - arm_x), y + (turned_y - arm_y)
        if x0 <= x <= x1 and y0 <= y <= y1:
            pixel = (pixel[0], *sweeps.cell(x, y))
            sharp_object_of[pixel] = min(sharp_object_of.get(pixel, number), number)
            moved.append((number, pixel, point._replace(x=x, y=y)))
    clouds: list[list[SweepPoint]] = [[] for _ in sweeps.clouds]
    for number, pixel, point in moved:
        if sharp_object_of[pixel] == number:
            clouds[pixel[0]].append(point)
    return sweeps.with_points(clouds), sharp_object_of
