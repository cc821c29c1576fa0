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
from cflow_torch.ops.indices import constant, flat_nonzero, gather, lookup, scatter_count
from cflow_torch.ops.linear import adjugate
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.surface_spread import NOISE, spread_of
from cflow_torch.verified.voxel_centroids import UNITS, ObjectPoints, Voxels, whole

# We chose these on real pairs and windows with history (docs/benchmarks.md).
LAYER_HEIGHT, NUM_LAYERS = 0.1, 32  # of the voxels, metres
_FARTHEST = 0.2  # metres, between the voxels of a pair
_FAR = 3.0  # squared distance of a pair, in standard deviations of both surfaces, at which its weight is a quarter
_MOST_TIME = 2.5  # sweep intervals: t, t-1 and their jitter; older sweeps pull where the rotation is not constant
_NUM_STEPS = 4
_STEP_LENGTH = 1.4  # of that of Gauss and Newton: nearest partners change with each step, so theirs falls short
# From the given flow in x and in y, metres per interval, and from no rotation, tangent of half the angle per interval.
_LARGEST_CHANGE = (0.15, 0.15, 0.1)
# Pairs of points without a surface that the given translation is worth, and, at a distance of 1 m, no rotation.
_HELD, _HELD_ROTATION = 2.0, 5.0
_ARM = 64  # arms are whole 64ths of a metre, and weights whole 256ths: sums are exact in any order
# An object that covers a quarter of a turn of the sensor in an interval would be nearer than its own length. Times that
# differ by more are those of a direction that is measured at the end of one sweep and at the start of the next.
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
    pairs, device = _VoxelPairs(points, sweeps, len(flow)), flow.device
    # The motion: x, y and the tangent of half the angle, (3, G). The angle is twice its tangent, nearly.
    given = motion = F.pad(flow, (0, 1)).t()
    held = constant((_HELD, _HELD, 4 * _HELD_ROTATION), torch.float64, device)[:, None]
    largest = constant(_LARGEST_CHANGE, torch.float64, device)[:, None]
    lower, upper = given - largest, given + largest
    for _ in range(_NUM_STEPS):
        equations = pairs.normal_equations(motion)
        force = equations[:, 3] + held * (given - motion)
        inverse, scale = adjugate(equations[:, :3] + torch.diag(held[:, 0])[:, :, None])
        change = (inverse * force).sum(1) / scale
        motion = torch.clamp(torch.add(motion, change, alpha=_STEP_LENGTH), lower, upper)
    corner = constant(sweeps.grid.lower[:2], torch.float64, device)
    return RigidMotion(motion[:2].t().contiguous(), motion[2], torch.view_as_real(pairs.centre) / UNITS + corner)


def stretch_of(points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion) -> Tensor:
    """Ratio of the time between two measurements of an object to the time between the sweeps.

    Args:
        points: of the objects that move, with times.
        sweeps: finest images.
        rigid: apparent motion of G objects: the result of `register`.

    Returns:
        (G,) float64: sum of w k (k + b - a) over the sum of w k^2, over all pairs of voxels; w is the weight of a pair
        in x plus that in y, k the intervals between its sweeps, a and b the mean times of its voxels in intervals. The
        motion divided by this ratio explains the pairs best. 1 for objects without pairs, and where it is below 0.75.

    Convention: k is rounded to a 16th and b - a to a 1024th, halves up.
    """
    motion = torch.cat((rigid.flow.t(), rigid.rotation[None]))
    equations = _VoxelPairs(points, sweeps, len(rigid.flow)).normal_equations(motion)
    squares, late = equations[0, 0] + equations[1, 1], equations[0, 4]
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
        position = F.pad(torch.view_as_real(voxels.position[at_t]), (0, 1), value=1.0).t()
        *sums, count = scatter_count(voxels.object_id[at_t], num_objects, position)
        self.centre = torch.complex(*(torch.floor(total / count.clamp(min=1)) for total in sums))
        self._voxel = flat_nonzero((voxels.step != 0) & (count > 0).index_select(0, voxels.object_id))
        window, step, self._object = gather(self._voxel, voxels.window, voxels.step, voxels.object_id)
        self._sweep = window * sweeps.num_steps  # t+1
        self._elapsed = elapsed.index_select(0, self._sweep + step)
        self._end = sweeps.elapsed[:, 1].index_select(0, window)
        self._object_of_voxel = F.pad(voxels.object_id, (0, 1), value=-1)
        noise = NOISE**2 / 2 * torch.eye(3, dtype=torch.float64, device=points.object_id.device)[:, :, None]
        self._spread = F.pad(spread_of(voxels, sweeps.grid.pixel_size, LAYER_HEIGHT), (0, 1)) + noise

    def normal_equations(self, motion: Tensor) -> Tensor:
        """Sums over the pairs of each object under a motion.

        Args:
            motion: (3, G) float64, x and y in metres per interval, and the tangent of half the angle.

        Returns:
            (3, 4, G) float64: the normal matrix and, in column 3, the force. Where there are times, (3, 5, G), with
            w k (b - a) as in `stretch_of` in column 4.
        """
        speed = torch.complex(motion[0], motion[1]) * UNITS
        state = torch.stack((self.centre, speed, motion[2].to(speed.dtype)))
        num_columns = 4 if self._voxels.time is None else 5
        total = motion.new_zeros(3 * num_columns * self._num_objects)
        row = torch.arange(3 * num_columns, device=motion.device)[:, None] * self._num_objects
        for some in chunks(0, self._voxel.numel(), motion.device, 27):
            index = self._object[some]
            terms = self._terms(some, index, *state.index_select(1, index).unbind(0))
            total.index_add_(0, (index + row).view(-1), terms.view(-1))
        return total.view(3, num_columns, self._num_objects)

    def _terms(self, some: slice, index: Tensor, centre: Tensor, velocity: Tensor, rotation: Tensor) -> Tensor:
        """(3, 4 or 5, K) summands of some voxels."""
        voxels, voxel, elapsed, end = self._voxels, self._voxel[some], self._elapsed[some], self._end[some]
        position, height, layer = gather(voxel, voxels.position, voxels.height, voxels.layer)
        arm = rotate(rotation.real * elapsed, position - centre - velocity * (end - elapsed))
        target = whole(centre + velocity * end + arm)
        other = voxels.nearest(self._sweep[some], layer, target, height)
        error = torch.view_as_real(voxels.position.index_select(0, other) - target).t()
        error = torch.cat((error, (voxels.height.index_select(0, other) - height)[None]))
        is_pair = self._object_of_voxel.index_select(0, other) == index
        is_pair &= error.square().sum(0) <= round((_FARTHEST * UNITS) ** 2)
        error = error * is_pair / UNITS

        inverse, scale = adjugate(self._spread.index_select(2, voxel) + self._spread.index_select(2, other))
        square = ((inverse * error).sum(1) * error).sum(0) / scale
        weight = (_FAR / (_FAR + square)).square_() * is_pair / scale * NOISE**2
        weight = whole(256 * (inverse[:2] * weight)) / 256

        # Derivative of the position at t+1, (2, 3, K), whole 16ths times whole 64ths of a metre.
        k, one = whole(16 * elapsed) / 16, torch.ones_like(elapsed)
        r_x, r_y = torch.view_as_real(whole(arm / (UNITS / _ARM)) / (_ARM / 2)).unbind(1)
        zero = torch.zeros_like(one)
        change = torch.stack((one, zero, -r_y, zero, one, r_x)).view(2, 3, -1) * k
        weighted = (weight[:, :2, None] * change).sum(1)
        columns = torch.cat((weighted, (weight * error).sum(1)[:, None]), 1)
        terms = (change[:, :, None] * columns[:, None]).sum(0)
        if voxels.time is None:
            return terms
        late = (lookup(voxels.time, other) - voxels.time.index_select(0, voxel)) * is_pair
        late = (weight[0, 0] + weight[1, 1]) * k * (whole(UNITS * late) / UNITS)
        return torch.cat((terms, late.expand(3, 1, -1)), 1)
