"""Rigid registration: a few Gauss-Newton steps on the voxels of objects, surface to surface, all objects at once.

Beams hit a surface at positions that are fixed in the frame of the vehicle. So the nearest points of two sweeps pull a
moving surface along itself. Therefore a pair counts only across the surface: it weighs the less in a direction, the
farther the voxels around extend in it (generalised ICP).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, gather, lookup, scatter_count
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.surface_spread import NOISE, spread_of, symmetric_adjugate
from cflow_torch.verified.voxel_centroids import UNITS, ObjectPoints, Voxels, square_of, whole

# We chose these on real pairs and windows with history (docs/benchmarks.md).
LAYER_HEIGHT, NUM_LAYERS = 0.1, 32  # of the voxels, metres
_FARTHEST = 0.2  # metres, between the voxels of a pair
_FAR = 3.0  # squared distance of a pair, in standard deviations of both surfaces, at which its weight is a quarter
_MOST_TIME = 2.5  # sweep intervals: t, t-1 and their jitter; older sweeps pull where the rotation is not constant
_NUM_STEPS = 4
_STEP_LENGTH = 1.4  # of that of Gauss and Newton: nearest partners change with each step, so theirs falls short
_LONGEST_CORRECTION = 0.15  # metres per interval, in x and in y, from the given flow
_LARGEST_ROTATION = 0.1  # tangent of half the angle per interval
# Pairs of points without a surface that the given translation is worth, and, at a distance of 1 m, no rotation.
_HELD, _HELD_ROTATION = 2.0, 5.0
_ARM = 64  # arms are whole 64ths of a metre, and weights whole 256ths: sums are exact in any order
# An object that covers a quarter of a turn of the sensor in an interval would be nearer than its own length. Times that
# differ by more are those of a place that is measured at the end of one sweep and at the start of the next.
_LEAST_STRETCH = 0.75


def register(points: ObjectPoints, sweeps: HeightSlicedSweeps, flow: Tensor) -> RigidMotion:
    """Refine the motion of every object by the voxels that meet under it, and estimate its rotation.

    Every voxel of another sweep is paired with the nearest one of its object at t+1. Each step minimises the errors
    over translation and angle. Two more terms hold on to the given translation and to no rotation.

    Args:
        points: of the objects that move, of all sweeps.
        sweeps: finest images.
        flow: (G, 2) float64, x and y, metres per sweep interval, to start from.

    Returns:
        The motion. An object without points at t keeps its flow.

    Cost: 27 lookups a step for each voxel and sweep, and twice 27 searches for each block of voxels.
    """
    pairs = _VoxelPairs(points, sweeps, len(flow))
    velocity, rotation = flow, torch.zeros_like(flow[:, 0])
    for _ in range(_NUM_STEPS):
        velocity, rotation = _solve(flow, velocity, rotation, pairs.normal_equations(velocity, rotation))
    corner = torch.tensor(sweeps.grid.lower[:2], dtype=torch.float64, device=flow.device)
    centre = torch.view_as_real(pairs.centre) / UNITS + corner
    return RigidMotion(velocity, rotation, centre)


def stretch_of(points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion) -> Tensor:
    """Ratio of the time between two measurements of an object to the time between the sweeps.

    Args:
        points: of the objects that move, with times.
        sweeps: finest images.
        rigid: apparent motion of G objects: the result of `register`.

    Returns:
        (G,) float64: sum of w k (k + b - a) over the sum of w k^2, over all pairs of voxels; w is the weight of a pair
        in x plus that in y, k the intervals between its sweeps, a and b the mean times of its voxels in intervals. So
        the motion divided by it explains the pairs best. 1 for objects without pairs, and where it is below 0.75.

    Convention: k is rounded to a 16th and b - a to a 1024th, halves up.
    """
    sums = _VoxelPairs(points, sweeps, len(rigid.flow)).normal_equations(rigid.flow, rigid.rotation)
    squares, late = sums[0] + sums[2], sums[-1]
    stretch = torch.where(squares > 0, 1 + late / squares, torch.ones_like(squares))
    return torch.where(stretch < _LEAST_STRETCH, torch.ones_like(stretch), stretch)


class _VoxelPairs:
    """Voxels of G objects in the sweeps that are paired with t+1. The plane is that of complex numbers, in units.

    Attributes:
        centre: (G,) complex128, mean of the centroids at t, whole units.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_objects: int) -> None:
        elapsed = sweeps.elapsed.flatten()
        of_point = elapsed.index_select(0, points.window * sweeps.num_steps + points.step)
        points = points.take((points.step == 0) | (of_point != 0) & (of_point.abs() <= _MOST_TIME))
        voxels = Voxels(points, sweeps, NUM_LAYERS)
        self._voxels, self._num_objects = voxels, num_objects
        at_t = flat_nonzero(voxels.step == 1)
        position = F.pad(torch.view_as_real(voxels.place[at_t]).t(), (0, 0, 0, 1), value=1.0)
        *sums, count = scatter_count(voxels.owner[at_t], num_objects, position)
        self.centre = torch.complex(*(torch.floor(total / count.clamp(min=1)) for total in sums))
        self._voxel = flat_nonzero((voxels.step != 0) & (count > 0).index_select(0, voxels.owner))
        window, step, self._object = gather(self._voxel, voxels.window, voxels.step, voxels.owner)
        self._sweep = window * sweeps.num_steps  # t+1
        self._elapsed = elapsed.index_select(0, self._sweep + step)
        self._end = sweeps.elapsed[:, 1].index_select(0, window)
        self._object_of_voxel = F.pad(voxels.owner, (0, 1), value=-1)
        self._spread = F.pad(spread_of(voxels, sweeps.grid.pixel_size, LAYER_HEIGHT), (0, 0, 0, 1))

    def normal_equations(self, velocity: Tensor, rotation: Tensor) -> Tensor:
        """Sums over the pairs of each object under a motion, (9 or 10, G) float64.

        They are the normal matrix (xx, xy, yy, x angle, y angle, angle angle) and the force (x, y, angle) of the
        translation in metres and the angle in radians, per interval; and, where there are times, w k (b - a) as in
        `stretch_of`.

        Args:
            velocity: (G, 2) float64, metres per interval.
            rotation: (G,) float64, tangent of half the angle per interval.
        """
        speed = torch.view_as_complex(velocity.contiguous() * UNITS)
        motion = torch.stack((self.centre, speed, rotation.to(speed.dtype)))
        num_sums = 9 if self._voxels.time is None else 10
        total = velocity.new_zeros((num_sums, self._num_objects))
        row = torch.arange(num_sums, device=rotation.device)[:, None] * self._num_objects
        for some in chunks(0, self._voxel.numel(), rotation.device, 27):
            index = self._object[some]
            terms = self._terms(some, index, *motion.index_select(1, index).unbind(0))
            total.view(-1).index_add_(0, (index + row).view(-1), terms.view(-1))
        return total

    def _terms(self, some: slice, index: Tensor, centre: Tensor, velocity: Tensor, rotation: Tensor) -> Tensor:
        """(9 or 10, K) summands of some voxels."""
        voxels, voxel, elapsed, end = self._voxels, self._voxel[some], self._elapsed[some], self._end[some]
        place, height, part = gather(voxel, voxels.place, voxels.height, voxels.part)
        arm = rotate(rotation.real * elapsed, place - centre - velocity * (end - elapsed))
        target = whole(centre + velocity * end + arm)
        other = voxels.nearest(self._sweep[some], part, target, height)
        error = voxels.place.index_select(0, other) - target
        error_z = voxels.height.index_select(0, other) - height
        is_pair = self._object_of_voxel.index_select(0, other) == index
        is_pair &= square_of(error) + error_z * error_z <= round((_FARTHEST * UNITS) ** 2)
        x, y, z = torch.stack((error.real, error.imag, error_z)) * is_pair / UNITS

        xx, xy, xz, yy, yz, zz = (self._spread.index_select(0, voxel) + self._spread.index_select(0, other)).unbind(1)
        noise = NOISE**2
        (xx, xy, xz, yy, yz, zz), det = symmetric_adjugate(xx + noise, xy, xz, yy + noise, yz, zz + noise)
        square = (xx * x * x + yy * y * y + zz * z * z + 2 * (xy * x * y + xz * x * z + yz * y * z)) / det
        weight = _FAR / (_FAR + square)
        weight = weight * weight * is_pair / det * noise
        xx, xy, xz, yy, yz = whole(256 * (torch.stack((xx, xy, xz, yy, yz)) * weight)) / 256
        force_x, force_y = xx * x + xy * y + xz * z, xy * x + yy * y + yz * z

        r_x, r_y = (torch.view_as_real(whole(arm / (UNITS / _ARM))) / _ARM).unbind(1)
        k = whole(16 * elapsed) / 16
        kk = k * k
        x_angle, y_angle = kk * (xy * r_x - xx * r_y), kk * (yy * r_x - xy * r_y)
        terms = [kk * xx, kk * xy, kk * yy, x_angle, y_angle, r_x * y_angle - r_y * x_angle]
        terms += [k * force_x, k * force_y, k * (r_x * force_y - r_y * force_x)]
        if voxels.time is not None:
            late = (lookup(voxels.time, other) - voxels.time.index_select(0, voxel)) * is_pair
            terms.append((xx + yy) * k * (whole(UNITS * late) / UNITS))
        return torch.stack(terms)


def _solve(given: Tensor, velocity: Tensor, rotation: Tensor, sums: Tensor) -> tuple[Tensor, Tensor]:
    """The motion after a Gauss-Newton step.

    Args:
        given: (G, 2) float64, velocity that is held on to, metres per interval.
        velocity, rotation: of G objects, as for `normal_equations`.
        sums: as `normal_equations` gives them.
    """
    xx, xy, yy, x_angle, y_angle, angle_angle = sums[:6]
    x, y = sums[6:8] + _HELD * (given - velocity).t()
    angle = sums[8] - _HELD_ROTATION * 2 * rotation
    (xx, xy, x_angle, yy, y_angle, angle_angle), det = symmetric_adjugate(
        xx + _HELD, xy, x_angle, yy + _HELD, y_angle, angle_angle + _HELD_ROTATION
    )
    change = torch.stack((xx * x + xy * y + x_angle * angle, xy * x + yy * y + y_angle * angle), 1) / det[:, None]
    turned = (x_angle * x + y_angle * y + angle_angle * angle) / det
    velocity = torch.clamp(velocity + _STEP_LENGTH * change, given - _LONGEST_CORRECTION, given + _LONGEST_CORRECTION)
    return velocity, (rotation + _STEP_LENGTH * turned / 2).clamp(-_LARGEST_ROTATION, _LARGEST_ROTATION)
