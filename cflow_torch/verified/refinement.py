"""Refinement: turn pixel motions into rigid motions accurate to centimetres, with rotation and the times of points.

Registration takes a few Gauss-Newton steps on the voxels of all objects at once. Beams hit a surface at positions that
are fixed in the frame of the vehicle. Pairs of nearest points would align these positions, and so give the surface a
wrong motion along itself. Therefore a pair counts mainly across the surface: the farther the voxels around the pair
extend in a direction, the lower is the weight of the pair in that direction (generalised ICP).
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import constant, flat_nonzero, gather, lazy_zeros, lookup, scatter_count, take_columns
from cflow_torch.ops.linear import adjugate
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.component_tree import Components, Objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps, Pixels
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.subpixel_motion import NUM_STEPS, STEP_LENGTH, subpixel_motion
from cflow_torch.verified.voxel_centroids import NOISE, UNITS, ObjectPoints, Voxels, points_of_objects, spread_of

# We chose these values on real pairs and windows with history (docs/benchmarks.md).
LAYER_HEIGHT, NUM_LAYERS = 0.1, 32  # of the voxels: height in metres, number of layers before they repeat
_FARTHEST = 0.2  # metres, between the voxels of a pair
_FAR = 3.0  # squared distance of a pair, in variances of both surfaces, at which its weight is a quarter
MOST_TIME = 2.5  # sweep intervals: t, t-1 and jitter; older sweeps mislead if the rotation is not constant
_WEIGHT, _ARM = 256, 16  # weights are multiples of 1/256, arms of 16 units, so sums are exact in any order
# Weights that hold x and y near the given translation, and the tangent of half the angle near zero: as firmly as two
# pairs of voxels with equal spread in all directions, and five such pairs 1 m from the centre.
_HELD = (2.0 * _WEIGHT, 2.0 * _WEIGHT, 5.0 * _WEIGHT * (2 * UNITS) ** 2)
# At 0.75, the beam hits the object a quarter turn earlier than in the sweep before. To move that far around the
# sensor, it would have to be nearer than its own length. So at smaller ratios, the seam between sweeps crosses it.
_LEAST_STRETCH = 0.75


def refine(
    sweeps: HeightSlicedSweeps, components: Components, objects: Objects, motion: Tensor, longest: float | None
) -> tuple[RigidMotion, RigidMotion]:
    """Return the final motion of objects, and their apparent motion, which differs from it if points have times.

    `motion` is (G, 2) float64, (y, x), finest pixels per sweep interval. Static objects longer than `longest` metres at
    t+1 stay static. None = no bound.
    """
    # A static object of a pair is a whole component. Objects of copies get length 0, which has no effect, as they move.
    length = lookup(components.length, objects.component.clamp(max=components.count))
    start = subpixel_motion(sweeps, objects, motion, length <= (math.inf if longest is None else longest))
    points = points_of_objects(sweeps, objects, start.any(1), LAYER_HEIGHT, NUM_LAYERS, MOST_TIME)
    return register_deskewed(points, sweeps, start)


def register_deskewed(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, start: Tensor
) -> tuple[RigidMotion, RigidMotion]:
    """Register objects, and correct their motion per sweep interval for the times of points.

    Args:
        points: points of the objects that move, as `VoxelPairs` takes them.
        start: (G, 2) float64, x and y, metres per sweep interval, from which registration starts.

    Returns:
        The motion, and the apparent motion, which registration finds. Without times, both are equal. With times, we
        divide the translation by `VoxelPairs.stretch`. In windows with history, we then de-skew the points by the new
        motion, and register them again from `start / stretch`. Windows of two sweeps are not de-skewed, because
        without a third sweep, smooth surfaces would slide along the pattern of the beams.

    Convention: times of 0 give the same bits as no times.

    Cost: two registrations with times, else one; a sort of the points.
    """
    pairs = VoxelPairs(points, sweeps, len(start))
    apparent = pairs.register(start)
    if points.time is None:
        return apparent, apparent
    stretch = pairs.stretch(apparent)[:, None]
    divided = RigidMotion(apparent.flow / stretch, apparent.rotation, apparent.centre)
    has_history = sweeps.has_history.index_select(0, sweeps.pixels.window.index_select(0, points.pixel))
    points = points.at(flat_nonzero(has_history))
    again = VoxelPairs(*deskew(points, sweeps, divided), len(start)).register(start / stretch)
    is_again = torch.bincount(points.object_id, minlength=len(start)) > 0
    deskewed = RigidMotion(
        torch.where(is_again[:, None], again.flow, divided.flow),
        torch.where(is_again, again.rotation, divided.rotation),
        torch.where(is_again[:, None], again.centre, divided.centre),
    )
    return deskewed, apparent


class VoxelPairs:
    """The voxels of G objects, each paired with the nearest voxel of the same object at t+1.

    Inside, lengths are in units of 1 / `UNITS` m, and vectors in the x-y plane are complex numbers.

    Args:
        points: the points of the moving objects, in sweeps at most `MOST_TIME` sweep intervals from t+1.

    Cost: as `spread_of`.
    """

    def __init__(self, points: ObjectPoints, sweeps: HeightSlicedSweeps, num_objects: int) -> None:
        self._voxels = voxels = Voxels(points, sweeps, NUM_LAYERS)
        device = points.position.device
        at_t = flat_nonzero(voxels.step == 1)
        x, y = take_columns(voxels.position[:2], at_t)
        summed = torch.stack((x, y, torch.ones_like(x)))
        sums = scatter_count(voxels.object_id.index_select(0, at_t), num_objects, summed)
        self._centre_of_object = torch.complex(*torch.floor(sums[:2] / sums[2].clamp(min=1)))
        # Object, spread and position of each voxel; the last entry, for "no voxel", is far from all others.
        spread = spread_of(voxels, sweeps.grid.pixel_size, LAYER_HEIGHT).view(9, -1)
        self._table = torch.cat((F.pad(torch.cat((voxels.object_id[None], spread)), (0, 1)), voxels.position))
        self._corner = constant(sweeps.grid.lower[:2], torch.float64, device)

        # The voxels that we pair with those of t+1.
        self._voxel = flat_nonzero((voxels.step != 0) & (sums[2] > 0).index_select(0, voxels.object_id))
        of_voxel = (voxels.window, voxels.pixel, voxels.layer, voxels.object_id)
        window, pixel, layer, self._object = gather(self._voxel, *of_voxel)
        self._chunks = list(chunks(0, len(self._voxel), device, 27))
        self._sweep = window * sweeps.num_steps  # t+1
        self._layers = (layer + constant(((-1,), (0,), (1,)), torch.int64, device)) & (NUM_LAYERS - 1)
        self._elapsed = sweeps.elapsed_of_pixel.index_select(0, pixel)
        self._k = (self._elapsed * 16).round_() / 16
        end = sweeps.elapsed[:, 1].index_select(0, window)
        x, y, self._height = take_columns(voxels.position, self._voxel)
        centre = self._centre_of_object.index_select(0, self._object)
        # The flow moves the arm of a voxel from its own sweep to t, and the centre of the object from t to t+1.
        self._arm_and_centre = torch.stack((torch.complex(x, y) - centre, centre))
        self._intervals = torch.stack((self._elapsed - end, end))
        variance = (NOISE * UNITS) ** 2
        noise = constant(tuple(variance if i % 4 == 0 else 0.0 for i in range(9)), torch.float64, device)
        self._own_spread = take_columns(spread, self._voxel) + noise[:, None]
        # Derivatives of the position (x, y, z) at t+1. By the motion per interval in x or in y: k or 0. By the tangent
        # of half the angle: the arm, rotated by a right angle, times 2 k.
        axes = constant(((1.0, 0.0), (0.0, 1.0), (0.0, 0.0)), torch.float64, device)
        self._by_flow, self._by_tangent = axes[..., None] * self._k, self._k * (2 * _ARM)

    def register(self, flow: Tensor) -> RigidMotion:
        """Refine the motion of every object, and estimate its rotation.

        We pair every voxel of the other sweeps with the nearest voxel of its object at t+1. Each step minimises the
        errors of the pairs over translation and angle. Two more terms keep the translation near the given one, and the
        rotation near zero.

        Args:
            flow: (G, 2) float64, x and y, metres per sweep interval, to start from.

        Returns:
            The motion. An object without points at t keeps the given flow.

        Cost: 27 lookups a step for each voxel of the sweeps other than t+1.
        """
        given = motion = F.pad(flow * UNITS, (0, 1)).t()  # x, y and the tangent of half the angle, (3, G)
        held = constant(_HELD, torch.float64, flow.device)[:, None]
        hold = torch.diag(held[:, 0])[..., None].expand(-1, -1, len(flow))
        for _ in range(NUM_STEPS):
            equations = torch.cat((hold, (held * (given - motion))[:, None]), 1)
            for some in self._chunks:
                self._add_equations(equations, motion, some)
            inverse, scale = adjugate(equations[:, :3])
            change = (inverse * equations[:, 3]).sum(1) / scale
            motion = torch.add(motion, change, alpha=STEP_LENGTH)
        centre = torch.view_as_real(self._centre_of_object) / UNITS + self._corner
        return RigidMotion((motion[:2] / UNITS).t(), motion[2], centre)

    def stretch(self, rigid: RigidMotion) -> Tensor:
        """Return the time between two measurements of an object, divided by the time between their sweeps.

        Args:
            rigid: apparent motion of the objects, the result of `register`. The points have times.

        Returns:
            (G,) float64: the sum of w k (k + b - a) divided by the sum of w k^2, over all pairs of voxels. Here w is
            the weight of a pair in x plus that in y, k is the time from its sweep to t+1, and a and b are the mean
            times of the points in its voxels of that sweep and of t+1, all in sweep intervals. The motion divided by
            the ratio explains the pairs best. Objects without pairs, or with a ratio below 0.75, get 1.

        Convention: k is rounded to a 16th and b - a to a 1024th.
        """
        assert self._voxels.time is not None
        motion = torch.cat((rigid.flow.t() * UNITS, rigid.rotation[None]))
        time, sums = F.pad(self._voxels.time, (0, 1)), motion.new_zeros(2, len(rigid.rotation))
        for some in self._chunks:
            other, weight, _, _ = self._pairs(motion, some)
            late = time.index_select(0, other) - time.index_select(0, self._voxel[some])
            times = torch.stack((self._k[some], (late * UNITS).round_() / UNITS))
            terms = times * ((weight[0, 0] + weight[1, 1]) * self._k[some])
            sums.scatter_add_(1, self._object[some].expand(2, -1), terms)
        squares, late = sums
        stretch = torch.where(squares > 0, 1 + late / squares, 1.0)
        return torch.where(stretch < _LEAST_STRETCH, 1.0, stretch)

    def _add_equations(self, equations: Tensor, motion: Tensor, some: slice) -> None:
        """Pair some voxels under a motion, and add the pairs to the equations of their objects.

        The motion is (3, G) float64, x and y per interval and the tangent of half the angle. The equations are
        (3, 4, G) float64, normal matrices and, in column 3, right-hand sides, times 256.
        """
        _, weight, error, arm = self._pairs(motion, some)
        lever = torch.view_as_real(arm * (1j / _ARM)).round().t() * self._by_tangent[some]
        lever = torch.cat((lever, torch.zeros_like(lever[:1])))  # `F.pad` of torch 2.0 fails without voxels
        columns = torch.cat((self._by_flow[..., some], lever[:, None], error[:, None]), 1)
        weighted = (weight[:, :, None] * columns).sum(1)
        terms = (columns[:2, :3, None] * weighted[:, None]).sum(0).view(12, -1)
        equations.view(12, -1).scatter_add_(1, self._object[some].expand(12, -1), terms)

    def _pairs(self, motion: Tensor, some: slice) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Pair some voxels with those of t+1 under a motion.

        Returns:
            other: (K,) int64, the voxel of t+1.
            weight: (2, 3, K) float64, rows x and y of the weight matrix, times 256, rounded; 0 = not paired.
            error: (3, K) float64, units, from the moved voxel to the other one.
            arm: (K,) complex128, from the centre at t+1 to the moved voxel.
        """
        index = self._object[some]
        v_x, v_y, rotation = take_columns(motion, index)
        arm, centre = self._arm_and_centre[:, some] + torch.complex(v_x, v_y) * self._intervals[:, some]
        arm = rotate(rotation * self._elapsed[some], arm)
        at = torch.view_as_real(centre + arm).round()
        target = torch.cat((at.t(), self._height[None, some]))
        other, is_near = self._voxels.nearest(self._sweep[some], self._layers[:, some], target, _FARTHEST)
        of_other = take_columns(self._table, other)
        is_pair = is_near & (of_other[0] == index)
        error, spread = of_other[10:] - target, self._own_spread[:, some] + of_other[1:10]
        inverse, scale = adjugate(spread.view(3, 3, -1))
        square = ((inverse * error).sum(1) * error).sum(0)
        # The weight matrix is (f / (f + d^2))^2 times the inverse of the spread, where d^2 = square / scale.
        weight = scale / torch.add(square, scale, alpha=_FAR).square_() * is_pair
        factor = _WEIGHT * (_FAR * NOISE * UNITS) ** 2
        return other, (inverse[:2] * (weight * factor)).round_(), error, arm


def deskew(
    points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion
) -> tuple[ObjectPoints, HeightSlicedSweeps]:
    """Move the points of objects to their positions at the instant of their sweep. The points have times.

    Returns:
        The moved points, and sweeps with the pixels of these points. The images of the sweeps are unchanged.

    Convention: translation and rotation are proportional to time. Points that leave the region are dropped. If several
    objects share a pixel, only the points of the first one are kept. Points whose time is 0 do not move.

    Cost: a sort of the points.
    """
    assert points.time is not None
    grid, num_steps, object_id = sweeps.grid, sweeps.num_steps, points.object_id
    time, (window, step) = points.time.double(), take_columns(sweeps.pixels.table[1:3], points.pixel)
    flow, centre = (torch.view_as_complex(values.index_select(0, object_id)) for values in (rigid.flow, rigid.centre))
    # `centre` is the centre at t. We move it to the instant of the sweep.
    image = torch.add(step, window, alpha=num_steps)
    since_t = (sweeps.elapsed[:, 1:2] - sweeps.elapsed).flatten().index_select(0, image)
    at_instant = torch.complex(*points.position[:2]) - flow * time
    arm = at_instant - centre - flow * since_t
    at_instant = at_instant + (rotate(-time * rigid.rotation.index_select(0, object_id), arm) - arm)
    position = torch.cat((torch.view_as_real(at_instant).t(), points.position[2:]))

    inside = flat_nonzero(grid.contains(position[:2]))
    position, image = take_columns(position, inside), image.index_select(0, inside)
    index = grid.pixel_of_image(position, image, sweeps.batch.num_windows * num_steps).long()
    pixel, number = torch.unique(index, return_inverse=True)
    moved = replace(points.at(inside), position=position, pixel=number)
    first = segment_amin(moved.object_id, number, pixel.numel(), len(rigid.rotation)).index_select(0, number)
    slices = torch.zeros_like(pixel, dtype=torch.uint8)  # unused by registration
    pixels = Pixels.of(pixel, slices, grid, num_steps)
    rank = lazy_zeros(len(sweeps.rank), torch.int32, pixel.device)
    rank.scatter_(0, pixel, torch.arange(1, len(pixel) + 1, dtype=torch.int32, device=pixel.device))
    drawn = replace(sweeps, pixels=pixels, rank=rank)
    return moved.at(flat_nonzero(moved.object_id == first)), drawn
