"""Rigid registration: a few Gauss-Newton steps on the voxels of objects, surface to surface.

An object rotates about a centre and moves on, both in proportion to the time that passes. Voxels, which are pixels by
layers of every sweep, are in units of 1/1024 m from the lower corner of the region; the rotation is the tangent of half
the angle.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple, Sequence

import numpy as np

from oracle.height_slices import SlicedSweeps, Vector, slice_of

LAYER_HEIGHT, NUM_LAYERS = 0.1, 64  # of voxels, metres; their number, then they repeat
FARTHEST = 0.2  # metres, between the voxels of a pair
FAR = 3.0  # squared distance of a pair, in standard deviations of both surfaces, at which its weight is a quarter
NOISE = 0.05  # metres, standard deviation of a centroid across its surface
MOST_TIME = 2.5  # sweep intervals: older sweeps are ignored
NUM_STEPS, STEP_LENGTH = 4, 1.4  # steps, as long as so many of Gauss and Newton
SAMPLE = 512  # voxels of an object, about, in the first half of the steps
HELD = (2.0, 2.0, 5.0)  # pairs that the given translation is worth, and, at 1 m, no rotation


class RigidMotion(NamedTuple):
    """Motion per sweep interval: (x, y) of the flow at the centre, rotation, centre; metres."""

    flow: Vector
    rotation: float
    centre: Vector

    def flow_at(self, points: np.ndarray) -> np.ndarray:
        """Flow of points of t by their positions; (N, 2), metres."""
        arm = points - self.centre
        return rotate(self.rotation, arm) - arm + self.flow


def rotate(rotation: float, arm: np.ndarray) -> np.ndarray:
    """Rotate (..., 2) by the angle whose half has the tangent `rotation`."""
    cos, sin = np.array([1 - rotation * rotation, 2 * rotation]) / (1 + rotation * rotation)
    return arm @ np.array([[cos, sin], [-sin, cos]])


class Voxels:
    """Voxels of the objects wanted, in the sweeps that are not far in time from t+1.

    Attributes:
        step, layer, object_id: (V,).
        bordered: the pixels of t+1, as `SlicedSweeps.number`, with a border of two pixels.
        position: (V, 3), centroid of its points in units from the lower corner and z = 0: each coordinate rounded to
            the nearest unit, their mean down to a whole one.
    """

    def __init__(self, sweeps: SlicedSweeps, object_of: np.ndarray, wanted: Sequence[bool]) -> None:
        self.sweeps, pixel = sweeps, sweeps.pixel_of_point
        is_near = np.abs(sweeps.elapsed[sweeps.pixels[:, 0]]) <= MOST_TIME
        rows = np.flatnonzero(np.array([*wanted, False])[object_of[pixel]] & is_near[pixel])
        points = sweeps.points[rows] - (*sweeps.lower, 0)
        key = pixel[rows] * NUM_LAYERS + slice_of(sweeps.points[rows, 2], LAYER_HEIGHT, NUM_LAYERS)
        keys, voxel, count = np.unique(key, return_inverse=True, return_counts=True)
        self.position = np.zeros((len(keys), 3))
        np.add.at(self.position, voxel, np.clip(points, -1e6, 1e6))
        self.position = self.position / count[:, None]
        pixel, self.layer = keys // NUM_LAYERS, keys % NUM_LAYERS
        self.step, self.object_id = sweeps.pixels[pixel, 0], object_of[pixel]
        self.plane = sweeps.pixels[pixel, 1:].sum(1) + self.layer
        self.number = {key: number for number, key in enumerate(keys.tolist())}
        self.bordered = np.pad(sweeps.number[0], 2, constant_values=-1)

    def of(self, object_id: int, most: float) -> np.ndarray:
        """The voxels of an object before t+1; if they are more than `most`, those in every n-th diagonal plane."""
        own = np.flatnonzero((self.object_id == object_id) & (self.step > 0))
        return own[self.plane[own] % max(1, math.ceil(len(own) / most)) == 0]

    def around(self, layer: int, position: np.ndarray) -> list[int]:
        """Voxels of t+1 in the 3 x 3 pixels around a position, in its layer and those next to it, the last of which is
        below the first: pixel by pixel in raster order. Beyond the border, there are none."""
        height, width = self.sweeps.number[0].shape
        col, row = (math.floor(x / self.sweeps.size) for x in position[:2].tolist())
        row, col = min(max(row, -1), height) + 2, min(max(col, -1), width) + 2
        square = self.bordered[row - 1 : row + 2, col - 1 : col + 2].ravel().tolist()
        keys = [pixel * NUM_LAYERS + (layer + up) % NUM_LAYERS for pixel, up in product(square, (-1, 0, 1))]
        return [self.number[key] for key in keys if key in self.number]


def register(sweeps: SlicedSweeps, object_of: np.ndarray, flow: Sequence[Vector]) -> list[RigidMotion]:
    """Refine the motion of every object, from (x, y) metres per interval. One without points at t keeps its flow."""
    voxels = Voxels(sweeps, object_of, [any(of_object) for of_object in flow])
    spread, result = spread_of(voxels), []
    for object_id, start in enumerate(flow):
        at_t = voxels.position[(voxels.object_id == object_id) & (voxels.step == 1), :2]
        if len(at_t) == 0:
            result.append(RigidMotion(start, 0.0, (0.0, 0.0)))
            continue
        centre, given = at_t.sum(0) / len(at_t), np.array([*start, 0.0])
        motion = given
        for step in range(NUM_STEPS):
            chosen = voxels.of(object_id, SAMPLE if step < NUM_STEPS // 2 else math.inf)
            motion = motion + STEP_LENGTH * gauss_newton(voxels, spread, object_id, chosen, centre, given, motion)
        x, y, rotation = motion.tolist()
        result.append(RigidMotion((x, y), rotation, tuple(centre + sweeps.lower)))
    return result


def gauss_newton(
    voxels: Voxels,
    spread: np.ndarray,
    object_id: int,
    chosen: np.ndarray,
    centre: np.ndarray,
    given: np.ndarray,
    motion: np.ndarray,
) -> np.ndarray:
    """Least squares: change of the translation (metres) and of the tangent, per interval.

    Minimises, over the pairs with times k and arms r, the squared errors that are left in x and y, each weighted, and
    the squares that hold on to the given translation and to no rotation. A pair is a voxel and the nearest one at t+1
    under the motion. Ties: the first of those around. If it is far, or of another object, there is no pair.
    """
    halves = np.array([1, 1, 2])  # the angle is twice the tangent
    matrix, force = np.diag(HELD), HELD * (given - motion) * halves
    velocity, elapsed = motion[:2], voxels.sweeps.elapsed
    for v in chosen.tolist():
        # The centre is that of t; it moves on, and the voxel rotates about it.
        position, layer, k = voxels.position[v], voxels.layer[v], elapsed[voxels.step[v]]
        arm = rotate(motion[2] * k, position[:2] - centre - velocity * (elapsed[1] - k))
        target = np.array([*(centre + velocity * elapsed[1] + arm), position[2]])
        near = voxels.around(layer, target)
        if not near:
            continue
        error = voxels.position[near] - target
        best = (error**2).sum(1).argmin()
        if voxels.object_id[near[best]] != object_id or (error[best] ** 2).sum() > FARTHEST**2:
            continue
        error = error[best]
        inverse = np.linalg.inv(spread[v] + spread[near[best]] + NOISE**2 * np.eye(3))
        weight = (FAR / (FAR + error @ inverse @ error)) ** 2 * NOISE**2 * inverse[:2]
        r_x, r_y = arm
        change = k * np.array([[1.0, 0.0, -r_y], [0.0, 1.0, r_x]])
        matrix = matrix + change.T @ weight[:, :2] @ change
        force = force + change.T @ weight @ error
    return np.linalg.solve(matrix, force) / halves


def spread_of(voxels: Voxels) -> np.ndarray:
    """(V, 3, 3) covariance, square metres, of the centroids of an object and sweep in the 3 x 3 x 3 blocks around each
    voxel.

    Blocks are 2 voxels wide. Centroids are whole 256ths of a metre.
    """
    spread, size = np.zeros((len(voxels.step), 3, 3)), np.array([voxels.sweeps.size] * 2 + [LAYER_HEIGHT])
    for v, (position, step, object_id) in enumerate(zip(voxels.position, voxels.step, voxels.object_id)):
        own = voxels.position[(voxels.step == step) & (voxels.object_id == object_id)]
        apart = np.floor(own / (2 * size)) - np.floor(position / (2 * size))
        near = own[(np.abs(apart) <= 1).all(1)]
        spread[v] = np.cov(near.T, bias=True)
    return spread
