"""Refinement: turn pixel motions into rigid motions accurate to centimetres, by generalised ICP.

Registration takes a few Gauss-Newton iterations on the voxels of all objects at once. The voxels of t+1 are the
target, and those of the other sweeps are the source. Beams hit a surface at positions that are fixed in the frame of
the vehicle. Correspondences of nearest points would align these positions, and so give the surface a wrong motion along
itself. Therefore a correspondence counts mainly across the surface: its information matrix is the inverse of the
covariance of the voxels around both ends.

    refine
        find_slow               in pairs, objects that may move by less than a pixel; they start with one pixel
        points_of_objects       the points of the moving objects
        register_deskewed
            Registration        voxels with centroids and covariances; the target and the source
                align           repeatedly: correspond (move the source, find the nearest target), linearise, solve.
                                The first half of the iterations uses a sample of large objects.
                improves        slow objects whose motion does not match better than none stay static
            if points have times:
                stretch         the time between two measurements of an object, by which we divide its motion
                if the window has history:
                    deskew          moves the points to the instant of their sweep
                    Registration    of the moved points
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Callable

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.groups import FAR, Groups
from cflow_torch.ops.indices import constant, flat_nonzero, take_columns
from cflow_torch.ops.linear import full, inverse, matvec, upper
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.selection import Objects
from cflow_torch.verified.slow_objects import find_slow
from cflow_torch.verified.voxel_centroids import (
    NUM_LAYERS,
    ObjectPoints,
    Voxels,
    VoxelSearch,
    covariance_of,
    points_of_objects,
)

# We chose these values on real pairs and windows with history (docs/benchmarks.md).
_NOISE = 0.05  # metres, standard deviation between two centroids, besides the covariances of their surfaces
_FARTHEST = 0.2  # metres, between the two voxels of a correspondence
_KERNEL = 3.0  # scale of the Geman-McClure kernel, in variances of the residual
# The prior holds x and y near the start as firmly as two correspondences do, and the tangent of half the angle near
# zero as firmly as five correspondences at 1 m from the centre.
_PRIOR = (2.0, 2.0, 20.0)
# The least ratio of `Registration.stretch`. At 0.75, the beam hits the object again after three quarters of a turn. An
# object that moves so far around the sensor in a sweep is nearer to it than its own length. So a smaller ratio means
# that the seam between two sweeps crosses the object.
_LEAST_STRETCH = 0.75
_NUM_ITERATIONS = 4
# What the motion of a slow object must gain: standard deviations of noise, and a share of a perfect match per voxel.
_SLOW_Z = 3.0
_LEAST_GAIN = 0.03
_SAMPLE = 512  # voxels of an object, about, in the first half of the iterations
STEP_LENGTH = 1.4  # of an iteration; above 1, because the nearest voxels change with each one


def refine(
    sweeps: HeightSlicedSweeps,
    objects: Objects,
    motion: Tensor,
    longest: float | None,
    slow: Callable[..., Tensor] = find_slow,
    num_iterations: int = _NUM_ITERATIONS,
) -> tuple[RigidMotion, RigidMotion]:
    """Return the final motion of objects, and their apparent motion, which differs from it if points have times.

    The apparent motion aligns the points as they were measured, at different times within their sweeps.

    Args:
        motion: (G, 2) float64, (y, x), finest pixels per sweep interval.
        longest: metres; static objects that are longer at t+1 stay static. None = no bound.
        slow: finds the objects of pairs that may move by less than a pixel.
        num_iterations: of registration.
    """
    flow = motion.flip(1) * sweeps.grid.pixel_size  # [G, 2], x and y, metres per sweep interval
    of_slow = slow(sweeps, objects, flow, longest)
    start = flow + of_slow
    points = points_of_objects(sweeps, objects, start.any(1))
    return register_deskewed(points, sweeps, start, of_slow.any(1), num_iterations)


def register_deskewed(
    points: ObjectPoints,
    sweeps: HeightSlicedSweeps,
    start: Tensor,
    is_slow: Tensor,
    num_iterations: int = _NUM_ITERATIONS,
) -> tuple[RigidMotion, RigidMotion]:
    """Register objects, and correct their motion per sweep interval for the times of points.

    Args:
        points: points of the objects that move, in sweeps at most `MOST_TIME` sweep intervals from t+1.
        start: (G, 2) float64, x and y, metres per sweep interval, from which registration starts.
        is_slow: (G,) bool, objects of pairs that stay static unless their motion matches better than none.

    Returns:
        The motion, and the apparent motion, which registration finds. Without times, both are equal. With times, we
        divide the translation by `Registration.stretch`. In windows with history, we then de-skew the points by the
        new motion, and register them again from `start / stretch`. Windows of two sweeps are not de-skewed, because
        without a third sweep, smooth surfaces would slide along the pattern of the beams.

    Cost: two registrations with times, else one; a few sorts of the points.
    """
    registration = Registration.of_objects(points, sweeps, len(start))
    apparent = registration.align(start, num_iterations)
    if sweeps.batch.has_pairs:
        apparent = apparent.only(~is_slow | registration.improves(apparent, is_slow))
    if points.time is None:
        return apparent, apparent
    stretch = registration.stretch(apparent)[:, None]
    divided = replace(apparent, flow=apparent.flow / stretch)
    with_history = points.at(flat_nonzero(sweeps.has_history.index_select(0, points.window)))
    deskewed = Registration.of_objects(deskew(with_history, sweeps, divided), sweeps, len(start))
    again = deskewed.align(start / stretch, num_iterations)
    is_again = Groups(with_history.object_id, len(start)).size() > 0
    return again.where(is_again, divided), apparent  # `again` where it is known, else `divided`


@dataclass(frozen=True)
class Source:
    """K voxels of the sweeps other than t+1, which we move to t+1."""

    voxel: Tensor  # (K,) int64
    by_object: Groups  # the voxels, grouped by object; each one is in a group
    centre: Tensor  # (2, K) float64, metres, x and y of the centre of its object at t
    offset: Tensor  # (2, K) float64, metres, x and y from that centre to the voxel
    height: Tensor  # (1, K) float64, metres, z of the voxel
    covariance: Tensor  # (6, K) float64, square metres, of the surface and of the noise, as in ops/linear.py
    target_start: Tensor  # (K,) int64, the cell (`Lattice`) of row 0 and column 0 of t+1 of its window
    target_layers: Tensor  # (3, K) int32, in which we search for the target
    elapsed: Tensor  # (K,) float64, sweep intervals from the voxel to t+1

    @classmethod
    def of(cls, voxels: Voxels, covariance: Tensor, by_object: Groups, centre: Tensor, elapsed: Tensor) -> Source:
        """Select the voxels of objects with points at t, in all sweeps but t+1.

        Args:
            covariance: (6, V) float64, square metres, of the surface around each voxel.
            by_object: the voxels, grouped by object.
            centre: (2, G) float64, NaN for objects without points at t.
            elapsed: (B, S) float64, sweep intervals from each sweep to t+1.
        """
        has_centre = by_object.spread(~centre[0].isnan())
        voxel = flat_nonzero(has_centre & (voxels.step > 0))
        by_object = by_object[voxel]
        window = voxels.window.index_select(0, voxel)
        up = constant(((-1,), (0,), (1,)), torch.int64, voxel.device)
        # The noise of a pair is added here, to its source.
        noise = constant((_NOISE**2, 0.0, 0.0, _NOISE**2, 0.0, _NOISE**2), torch.float64, voxel.device)[:, None]
        position = take_columns(voxels.position, voxel)  # [3, K]
        centre = take_columns(centre, by_object.of_item)  # [2, K]
        return cls(
            voxel=voxel,
            by_object=by_object,
            centre=centre,
            offset=position[:2] - centre,
            height=position[2:],
            covariance=take_columns(covariance, voxel) + noise,
            target_start=voxels.lattice.start(window * voxels.num_steps),  # of t+1
            target_layers=((voxels.layer.index_select(0, voxel) + up) % NUM_LAYERS).int(),
            elapsed=elapsed[window, voxels.step.index_select(0, voxel)],
        )

    def __len__(self) -> int:
        return len(self.voxel)

    def __getitem__(self, some: slice | Tensor) -> Source:
        """Select voxels by their positions in the list, a slice or (L,) int64."""
        return Source(
            voxel=self.voxel[some],
            by_object=self.by_object[some],
            centre=self.centre[:, some],
            offset=self.offset[:, some],
            height=self.height[:, some],
            covariance=self.covariance[:, some],
            target_start=self.target_start[some],
            target_layers=self.target_layers[:, some],
            elapsed=self.elapsed[some],
        )

    def sum_by_object(self, values_of: Callable[[Source], Tensor], num_rows: int) -> Tensor:
        """Sum R values of each voxel over its object, (R, G) float64; the bits do not depend on chunks.

        `values_of` computes the values of some of the voxels, (R, k), as many at once as suit the device.
        """
        sums = self.centre.new_zeros((num_rows, self.by_object.count + 1))
        for some in chunks(0, len(self), self.voxel.device, 9):
            source = self[some]
            source.by_object.add_to(sums, values_of(source))
        return sums[:, :-1]

    def sample(self, voxels: Voxels) -> Source:
        """Keep every n-th diagonal plane of voxels of each object; n is the least that keeps about `_SAMPLE`."""
        every = -(-self.by_object.size() // _SAMPLE)  # [G]
        plane = voxels.diagonal_plane().index_select(0, self.voxel)  # [K]
        return self[flat_nonzero(plane % self.by_object.spread(every) == 0)]


@dataclass(frozen=True)
class Correspondences:
    """The nearest voxel of the target of each of the K voxels of a source, under a motion."""

    target: Tensor  # (K,) int64, voxel of the target
    arm: Tensor  # (2, K) float64, metres, from the centre of the object at t+1 to the moved voxel
    weight: Tensor  # (K,) float64, 1 = at the same position, 0 = no pair
    pull: Tensor  # (3, K) float64, metres, information times the residual from the moved voxel to the target
    information: Tensor  # (3, 3, K) float64; the identity = a pair at distance 0 without surfaces, 0 = no pair


class Registration:
    """Aligns the voxels of G objects with those of the same objects at t+1.

    Args:
        voxels: those with the same `object_id` may match.
        by_object: the voxels, grouped by the motion that they share.
        centre: (2, G) float64, metres, x and y at t, about which each group rotates; NaN = it does not move.
        elapsed: (B, S) float64, sweep intervals from each sweep to t+1.

    Cost: as `covariance_of`.
    """

    def __init__(self, voxels: Voxels, by_object: Groups, centre: Tensor, elapsed: Tensor) -> None:
        self.voxels = voxels
        self._target = VoxelSearch(voxels, flat_nonzero(voxels.step == 0))
        self._covariance = covariance_of(voxels)  # [6, V]
        self._centre = centre
        self.source = Source.of(voxels, self._covariance, by_object, centre, elapsed)
        self._sample = self.source.sample(voxels)

    @classmethod
    def of_objects(cls, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_objects: int) -> Registration:
        """Prepare objects, each with one motion, from their points in sweeps at most `MOST_TIME` intervals from t+1."""
        voxels = Voxels.of(points, sweeps)
        by_object = Groups(voxels.object_id.masked_fill(voxels.object_id < 0, num_objects), num_objects)
        at_t = by_object.where(voxels.step == 1)
        centre = at_t.sum(voxels.position[:2]) / at_t.size()  # [2, G], at t; NaN without points
        return cls(voxels, by_object, centre, sweeps.elapsed)

    def align(self, start: Tensor, num_iterations: int = _NUM_ITERATIONS) -> RigidMotion:
        """Refine the motion of every object, and estimate its rotation.

        Each Gauss-Newton iteration minimises the weighted residuals of the correspondences over translation and angle,
        with a prior that keeps the translation near `start`, and the rotation near zero. The first half of the
        iterations uses a sample of about 512 voxels of each object.

        Args:
            start: (G, 2) float64, x and y, metres per sweep interval.

        Returns:
            The motion. An object without points at t keeps `start`.

        Cost: 27 lookups for each voxel of the source and each iteration.
        """
        prior = constant(_PRIOR, torch.float64, start.device)[:, None]  # [3, 1]
        held = upper(torch.diag_embed(prior[:, 0])[..., None])  # [6, 1]
        start = torch.cat((start, torch.zeros_like(start[:, :1])), 1).t()  # [3, G]
        motion = start  # x, y and the tangent of half the angle, per sweep interval
        for iteration in range(num_iterations):
            source = self._sample if iteration < num_iterations // 2 else self.source
            equations = source.sum_by_object(partial(self._equations, self._rigid(motion)), 9)
            right_side = prior * (start - motion) + equations[6:]  # [3, G]
            change = matvec(full(inverse(held + equations[:6])), right_side)
            motion = torch.add(motion, change, alpha=STEP_LENGTH)
        return self._rigid(motion)

    def _rigid(self, motion: Tensor) -> RigidMotion:
        """Return the motion of the objects from its parameters, (3, G): x, y and the tangent of half the angle."""
        return RigidMotion(motion[:2].t(), motion[2], self._centre.nan_to_num(0.0).t())

    def _equations(self, rigid: RigidMotion, source: Source) -> Tensor:
        """Return the normal equations of each voxel of the source, (6 + 3, K) float64."""
        return _normal_equations(self._correspond(source, rigid), source.elapsed)

    def _correspond(self, source: Source, rigid: RigidMotion) -> Correspondences:
        """Move the source to t+1, and find the nearest voxels of the target."""
        velocity = take_columns(rigid.flow.t(), source.by_object.of_item)  # [2, K]
        rotation = rigid.rotation.index_select(0, source.by_object.of_item)
        # The object rotates about its centre, which moves on from t to t+1. From the moved centre, `arm` leads to the
        # moved voxel.
        arm = rotate(rotation * source.elapsed, source.offset + velocity * (source.elapsed - 1))
        moved = source.centre + velocity + arm
        moved = torch.cat((moved, source.height))  # [3, K]

        # 0 = none: this voxel is far away, and belongs to no object.
        target = self._target.nearest(source.target_start, source.target_layers, moved)  # [K]
        residual = take_columns(self.voxels.position, target) - moved
        is_near = residual.square().sum(0) <= _FARTHEST**2
        object_id = self.voxels.object_id
        is_same = object_id.index_select(0, target) == object_id.index_select(0, source.voxel)
        covariance = source.covariance + take_columns(self._covariance, target)
        information = full(inverse(covariance))
        pull = matvec(information, residual)  # [3, K]
        square = (residual * pull).sum(0)  # squared Mahalanobis distance
        weight = (1 + square / _KERNEL).pow(-2) * (is_near & is_same)
        # In units of 1 / noise^2: two centroids without surfaces, at distance 0, have the identity as information.
        scale = weight * _NOISE**2
        return Correspondences(
            target=target,
            arm=arm,
            weight=weight,
            pull=pull * scale,
            information=information * scale,
        )

    def gains(self, rigid: RigidMotion, source: Source) -> Tensor:
        """Return what each of K voxels of the source gains by a motion, (K,) float64.

        This is the weight of its correspondence with the motion minus that without.

        Cost: 54 lookups for each voxel.
        """
        static = rigid.only(torch.zeros_like(rigid.rotation, dtype=torch.bool))
        gain = torch.empty_like(source.elapsed)
        for some in chunks(0, len(source), gain.device, 9):
            with_motion = self._correspond(source[some], rigid).weight
            gain[some] = with_motion - self._correspond(source[some], static).weight
        return gain

    def improves(self, rigid: RigidMotion, asked: Tensor) -> Tensor:
        """Tell which objects match t+1 significantly better with a motion than without, (G,) bool.

        `asked`, (G,) bool, are the objects to compare. The result is False for others.

        Convention: the sum of the gains of the voxels of an object must exceed `_SLOW_Z` standard deviations of noise,
            the root of the sum of squares, and reach `_LEAST_GAIN` per voxel.

        Cost: as for `gains`.
        """
        source = self.source[flat_nonzero(self.source.by_object.spread(asked))]
        gain = self.gains(rigid, source)
        total, square, count = source.by_object.sum(torch.stack((gain, gain.square(), torch.ones_like(gain))))
        return (total > _SLOW_Z * square.sqrt()) & (total >= _LEAST_GAIN * count)

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
        time = self.voxels.time
        assert time is not None

        def times(source: Source) -> Tensor:
            pairs = self._correspond(source, rigid)
            delay = time.index_select(0, pairs.target) - time.index_select(0, source.voxel)
            weight = (pairs.information[0, 0] + pairs.information[1, 1]) * source.elapsed
            return weight * torch.stack((source.elapsed, delay))

        square, late = self.source.sum_by_object(times, 2)
        stretch = torch.where(square > 0, 1 + late / square, 1.0)
        return torch.where(stretch < _LEAST_STRETCH, 1.0, stretch)


def _normal_equations(pairs: Correspondences, elapsed: Tensor) -> Tensor:
    """Linearise the residuals of K correspondences. Return the normal equations of each, (6 + 3, K) float64.

    First comes the hessian, then the right side, which is the negative gradient. `elapsed`, (K,) float64, are the sweep
    intervals from the source to t+1.

    The parameters are x, y and the tangent of half the angle. A change of x or y moves the voxel by the elapsed time, a
    change of the tangent by the elapsed time times `lever`. No parameter changes z.
    """
    lever = pairs.arm.flip(0) * constant(((-2.0,), (2.0,)), torch.float64, pairs.arm.device)  # [2, K]
    weight = pairs.information[:2, :2]  # [2, 2, K]
    weighted_lever = matvec(weight, lever)  # [2, K]
    of_angle = (lever * weighted_lever).sum(0)
    hessian = torch.stack(
        (weight[0, 0], weight[0, 1], weighted_lever[0], weight[1, 1], weighted_lever[1], of_angle)
    )  # as in ops/linear.py
    force = pairs.pull[:2]
    torque = (lever * force).sum(0, keepdim=True)
    # The hessian is quadratic in the elapsed time, the right side is linear.
    return torch.cat((hessian * elapsed, force, torque)) * elapsed


def deskew(points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion) -> ObjectPoints:
    """Move the points of objects to their positions at the instant of their sweep. The points have times.

    Convention: translation and rotation are proportional to time. Points that leave the region are dropped. If several
    objects share a pixel, only the points of the first one are kept. Points whose time is 0 do not move.

    Cost: a sort of the points.
    """
    position = torch.cat((_at_instant(points, sweeps.elapsed, rigid), points.position[2:]))
    inside = flat_nonzero(sweeps.grid.contains(position[:2]))
    points = points.at(inside)
    position = take_columns(position, inside)
    row_col = torch.stack(sweeps.grid.row_col(position)).long()
    moved = replace(points, position=position, place=torch.cat((points.place[:2], row_col)))

    pixel = sweeps.columns.lattice.cell(points.window * sweeps.num_steps + points.step, *row_col)
    pixel, number = torch.unique(pixel, return_inverse=True)
    pixels = Groups(number, len(pixel))
    first_object = pixels.min(points.object_id, empty=FAR)
    return moved.at(flat_nonzero(points.object_id == pixels.spread(first_object)))


def _at_instant(points: ObjectPoints, elapsed: Tensor, rigid: RigidMotion) -> Tensor:
    """Return x and y of each point at the instant of its sweep, (2, N) float64; exactly its position at time 0."""
    assert points.time is not None
    time = points.time.double()
    velocity = rigid.flow.index_select(0, points.object_id).t()  # [2, N]
    rotation = rigid.rotation.index_select(0, points.object_id)
    since_t = elapsed[points.window, 1] - elapsed[points.window, points.step]
    centre = rigid.centre.index_select(0, points.object_id).t() + velocity * since_t  # at the instant of the sweep
    position = points.position[:2]
    displacement = -velocity * time
    arm = position + displacement - centre
    return position + displacement + (rotate(-time * rotation, arm) - arm)
