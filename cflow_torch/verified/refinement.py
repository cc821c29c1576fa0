"""Refinement: turn pixel motions into rigid motions accurate to centimetres, by generalised ICP.

Registration takes a few Gauss-Newton steps on the voxels of all objects at once. The voxels of t+1 are the target, and
those of the other sweeps are the source. Beams hit a surface at positions that are fixed in the frame of the vehicle.
Correspondences of nearest points would align these positions, and so give the surface a wrong motion along itself.
Therefore a correspondence counts mainly across the surface: its information matrix is the inverse of the covariance of
the voxels around both ends.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.indices import constant, flat_nonzero, take_columns
from cflow_torch.ops.linear import inverse, matmul, matvec
from cflow_torch.verified.columns import REACH, Columns, Pixels
from cflow_torch.verified.component_tree import Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.subpixel_motion import NUM_STEPS, STEP_LENGTH, subpixel_motion
from cflow_torch.verified.voxel_centroids import ObjectPoints, Voxels, covariance_of, points_of_objects

# We chose these values on real pairs and windows with history (docs/benchmarks.md).
LAYER_HEIGHT, NUM_LAYERS = 0.1, 32  # of the voxels: height in metres, number of layers before they repeat
MOST_TIME = 2.5  # sweep intervals: t, t-1 and jitter; older sweeps mislead if the rotation is not constant
_NOISE = 0.05  # metres, standard deviation of a centroid, besides the covariance of its surface
_FARTHEST = 0.2  # metres, between the two voxels of a correspondence
_KERNEL = 3.0  # scale of the Geman-McClure kernel, in variances of both surfaces
# The prior holds x and y near the start as firmly as two correspondences do, and the tangent of half the angle near
# zero as firmly as five correspondences at 1 m from the centre.
_PRIOR = (2.0, 2.0, 20.0)
# At 0.75, the beam hits the object a quarter turn earlier than in the sweep before. To move that far around the
# sensor, it would have to be nearer than its own length. So at smaller ratios, the seam between sweeps crosses it.
_LEAST_STRETCH = 0.75


def refine(
    sweeps: HeightSlicedSweeps, objects: Objects, motion: Tensor, longest: float | None
) -> tuple[RigidMotion, RigidMotion]:
    """Return the final motion of objects, and their apparent motion, which differs from it if points have times.

    `motion` is (G, 2) float64, (y, x), finest pixels per sweep interval. Static objects longer than `longest` metres at
    t+1 stay static. None = no bound.
    """
    length = objects.length_at_newest(sweeps)
    start = subpixel_motion(sweeps, objects, motion, length <= (math.inf if longest is None else longest))
    points = points_of_objects(sweeps, objects, start.any(1), LAYER_HEIGHT, NUM_LAYERS, MOST_TIME)
    return register_deskewed(points, sweeps, start)


def register_deskewed(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, start: Tensor
) -> tuple[RigidMotion, RigidMotion]:
    """Register objects, and correct their motion per sweep interval for the times of points.

    Args:
        points: points of the objects that move, in sweeps at most `MOST_TIME` sweep intervals from t+1.
        start: (G, 2) float64, x and y, metres per sweep interval, from which registration starts.

    Returns:
        The motion, and the apparent motion, which registration finds. Without times, both are equal. With times, we
        divide the translation by `Registration.stretch`. In windows with history, we then de-skew the points by the
        new motion, and register them again from `start / stretch`. Windows of two sweeps are not de-skewed, because
        without a third sweep, smooth surfaces would slide along the pattern of the beams.

    Cost: two registrations with times, else one; a sort of the points.
    """
    registration = Registration(points, sweeps, len(start))
    apparent = registration.align(start)
    if points.time is None:
        return apparent, apparent
    stretch = registration.stretch(apparent)[:, None]
    divided = replace(apparent, flow=apparent.flow / stretch)
    has_history = sweeps.has_history.index_select(0, sweeps.pixels.window.index_select(0, points.pixel))
    points = points.at(flat_nonzero(has_history))
    again = Registration(*deskew(points, sweeps, divided), len(start)).align(start / stretch)
    is_again = Groups(points.object_id, len(start)).size() > 0
    return again.where(is_again, divided), apparent


@dataclass(frozen=True)
class Correspondences:
    """Some voxels of the source, each with the nearest voxel of the target, under a motion."""

    target: Tensor  # (K,) int64, voxel of the target; 0 = none
    residual: Tensor  # (3, K) float64, metres, from the moved voxel to the target
    information: Tensor  # (3, 3, K) float64, 0 without a target; 1 = a pair at distance 0 without surfaces
    arm: Tensor  # (2, K) float64, metres, from the centre of the object at t+1 to the moved voxel


class Registration:
    """Aligns the voxels of G objects with those of the same objects at t+1.

    Args:
        points: the points of the moving objects, in sweeps at most `MOST_TIME` sweep intervals from t+1.

    Cost: as `covariance_of`.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_objects: int) -> None:
        self._voxels = voxels = Voxels(points, sweeps, NUM_LAYERS)
        at_t = flat_nonzero(voxels.step == 1)
        objects = Groups(voxels.object_id[at_t], num_objects)
        size = objects.size()
        self.centre = objects.sum(take_columns(voxels.position[:2], at_t)) / size.clamp(min=1)  # [2, G], at t
        self._covariance = covariance_of(voxels, sweeps.grid.pixel_size, LAYER_HEIGHT).view(9, -1)  # [9, V]

        # The source: voxels of objects with points at t, in all sweeps but t+1. [K] each.
        has_points = torch.cat((size > 0, size.new_zeros(1, dtype=torch.bool)))
        self._source = flat_nonzero((voxels.step > 0) & has_points[voxels.object_id])
        self._objects = Groups(voxels.object_id[self._source], num_objects)
        self._position = take_columns(voxels.position, self._source)  # [3, K]
        noise = torch.eye(3, dtype=torch.float64, device=size.device).view(9, 1) * _NOISE**2
        self._source_covariance = take_columns(self._covariance, self._source) + noise  # [9, K]
        window = voxels.window[self._source]
        step = voxels.step[self._source]
        self._target_sweep = window * sweeps.num_steps
        up = constant(((-1,), (0,), (1,)), torch.int64, step.device)
        self._layers = (voxels.layer[self._source] + up) % NUM_LAYERS  # [3, K], to search in
        self._elapsed = sweeps.elapsed[window, step]  # sweep intervals from the voxel to t+1
        self._elapsed_of_t = sweeps.elapsed[window, 1]

    def align(self, start: Tensor) -> RigidMotion:
        """Refine the motion of every object, and estimate its rotation.

        Each Gauss-Newton step minimises the weighted residuals of the correspondences over translation and angle, with
        a prior that keeps the translation near `start`, and the rotation near zero.

        Args:
            start: (G, 2) float64, x and y, metres per sweep interval.

        Returns:
            The motion. An object without points at t keeps `start`.

        Cost: 27 lookups a step for each voxel of the source.
        """
        prior = constant(_PRIOR, torch.float64, start.device)
        start = torch.cat((start, torch.zeros_like(start[:, :1])), 1).t()  # [3, G]
        motion = start  # x, y and the tangent of half the angle, per sweep interval
        for _ in range(NUM_STEPS):
            hessian = torch.diag(prior)[..., None].repeat(1, 1, start.shape[1])  # [3, 3, G]
            gradient = prior[:, None] * (start - motion)  # [3, G]
            for some in chunks(0, len(self._source), start.device, 27):
                pairs = self._correspond(motion, some)
                self._linearise(pairs, some, hessian, gradient)
            motion = motion + STEP_LENGTH * matvec(inverse(hessian), gradient)
        return RigidMotion(motion[:2].t(), motion[2], self.centre.t())

    def _correspond(self, motion: Tensor, some: slice) -> Correspondences:
        """Move some voxels of the source to t+1, and find the nearest voxels of the target."""
        objects = self._objects[some]
        of_object = objects.spread(torch.cat((motion, self.centre)).t()).t()  # [5, K]
        velocity = of_object[:2]
        rotation = of_object[2]
        centre = of_object[3:]  # at t
        elapsed = self._elapsed[some]
        elapsed_of_t = self._elapsed_of_t[some]
        # The object rotates about its centre, which moves on.
        arm = self._position[:2, some] - (centre - velocity * (elapsed - elapsed_of_t))
        arm = rotate(rotation * elapsed, arm)
        moved = torch.cat((centre + velocity * elapsed_of_t + arm, self._position[2:, some]))  # [3, K]

        target = self._voxels.nearest(self._target_sweep[some], self._layers[:, some], moved)
        residual = take_columns(self._voxels.position, target) - moved
        is_near = residual.square().sum(0) <= _FARTHEST**2
        is_pair = is_near & (self._voxels.object_id.index_select(0, target) == objects.of_item)

        covariance = self._source_covariance[:, some] + take_columns(self._covariance, target)
        information = inverse(covariance.view(3, 3, -1))
        square = (residual * matvec(information, residual)).sum(0)  # Mahalanobis distance
        weight = (_KERNEL / (_KERNEL + square)).square() * _NOISE**2
        return Correspondences(target, residual, information * (weight * is_pair), arm)

    def _linearise(self, pairs: Correspondences, some: slice, hessian: Tensor, gradient: Tensor) -> None:
        """Add the normal equations of some correspondences to those of their objects, (3, 3, G) and (3, G)."""
        elapsed = self._elapsed[some]
        x, y = pairs.arm
        zero = torch.zeros_like(x)
        jacobian = torch.stack(  # of the moved voxel, by x, y and the tangent of half the angle
            (
                torch.stack((elapsed, zero, -2 * elapsed * y)),
                torch.stack((zero, elapsed, 2 * elapsed * x)),
                torch.stack((zero, zero, zero)),
            )
        )  # [3, 3, K]
        weighted = matmul(jacobian.transpose(0, 1), pairs.information)  # [3, 3, K]
        objects = self._objects[some]
        hessian += objects.sum(matmul(weighted, jacobian))
        gradient += objects.sum(matvec(weighted, pairs.residual))

    def stretch(self, rigid: RigidMotion) -> Tensor:
        """Return the time between two measurements of an object, divided by the time between their sweeps.

        Args:
            rigid: apparent motion of the objects, the result of `align`. The points have times.

        Returns:
            (G,) float64: the sum of w k (k + b - a) divided by the sum of w k^2, over all correspondences. Here w is
            the information in x plus that in y, k is the time from its sweep to t+1, and a and b are the mean times of
            the points in its voxels of that sweep and of t+1, all in sweep intervals. The motion divided by the ratio
            explains the correspondences best. Objects without any, or with a ratio below 0.75, get 1.
        """
        time = self._voxels.time
        assert time is not None
        motion = torch.cat((rigid.flow.t(), rigid.rotation[None]))
        square, late = torch.zeros_like(motion[:2])  # [G] each
        for some in chunks(0, len(self._source), motion.device, 27):
            pairs = self._correspond(motion, some)
            elapsed = self._elapsed[some]
            delay = time.index_select(0, pairs.target) - time.index_select(0, self._source[some])
            weight = (pairs.information[0, 0] + pairs.information[1, 1]) * elapsed
            square += self._objects[some].sum(weight * elapsed)
            late += self._objects[some].sum(weight * delay)
        stretch = torch.where(square > 0, 1 + late / square, 1.0)
        return torch.where(stretch < _LEAST_STRETCH, 1.0, stretch)


def deskew(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion
) -> tuple[ObjectPoints, HeightSlicedSweeps]:
    """Move the points of objects to their positions at the instant of their sweep. The points have times.

    Returns:
        The moved points, and sweeps with the pixels of these points. Their images have no slices.

    Convention: translation and rotation are proportional to time. Points that leave the region are dropped. If several
    objects share a pixel, only the points of the first one are kept. Points whose time is 0 do not move.

    Cost: a sort of the points.
    """
    assert points.time is not None
    window = sweeps.pixels.window.index_select(0, points.pixel)
    step = sweeps.pixels.step.index_select(0, points.pixel)
    position = torch.cat((_at_instant(points, sweeps.elapsed, window, step, rigid), points.position[2:]))

    inside = flat_nonzero(sweeps.grid.contains(position[:2]))
    position = take_columns(position, inside)
    columns, pixels, of_pixel = _draw_points(sweeps, position, window[inside], step[inside])
    moved = replace(points.at(inside), position=position, pixel=of_pixel.of_item)
    first_object = of_pixel.min(moved.object_id, empty=0)
    kept = flat_nonzero(moved.object_id == of_pixel.spread(first_object))
    return moved.at(kept), replace(sweeps, columns=columns, pixels=pixels)


def _draw_points(
    sweeps: HeightSlicedSweeps, position: Tensor, window: Tensor, step: Tensor
) -> tuple[Columns, Pixels, Groups]:
    """Draw points inside the region, without their height slices. Return columns, pixels, and the points by pixel."""
    grid = sweeps.grid
    num_windows = sweeps.batch.num_windows
    stride = grid.width + 2 * REACH
    row, col = grid.row_col(position)
    at = (window * (grid.height + 2 * REACH) + (row + REACH)) * stride + (col + REACH)
    is_occupied = torch.zeros(num_windows * (grid.height + 2 * REACH) * stride, dtype=torch.bool, device=at.device)
    columns = Columns.at(is_occupied.index_fill_(0, at, True), grid, sweeps.num_steps)
    column = columns.image.index_select(0, at).long()
    slices = columns.slices.new_zeros((len(columns.position), sweeps.num_steps))
    slices[column, step] = 1
    pixels = columns.draw(slices, 0, 0, num_windows)
    return columns, pixels, columns.pixel_at(column * columns.num_slots + step, len(pixels))


def _at_instant(points: ObjectPoints, elapsed: Tensor, window: Tensor, step: Tensor, rigid: RigidMotion) -> Tensor:
    """Return x and y of each point at the instant of its sweep, (2, N) float64."""
    assert points.time is not None
    time = points.time.double()
    velocity = rigid.flow.index_select(0, points.object_id).t()  # [2, N]
    rotation = rigid.rotation.index_select(0, points.object_id)
    since_t = elapsed[window, 1] - elapsed[window, step]
    centre = rigid.centre.index_select(0, points.object_id).t() + velocity * since_t  # at the instant of the sweep
    arm = points.position[:2] - velocity * time - centre
    return centre + rotate(-time * rotation, arm)
