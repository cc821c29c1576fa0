"""Rigid registration: a few Gauss-Newton steps on the voxel centroids of objects, all objects at once."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, gather, lookup, scatter_count
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import comparisons
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.voxel_centroids import UNITS, ObjectPoints, Voxels, meeting_weights, square_of, whole

# We chose these on real pairs and windows with history (docs/benchmarks.md). What holds on to the start keeps
# pedestrians from sliding along their few points. Older sweeps than these pull where an object does not turn at a
# constant rate.
LAYER_HEIGHT, NUM_LAYERS = 0.1, 16  # of the voxels, metres: on a sloping side, only points of like height lie alike
_SIGMA = 0.12  # metres, of the weight of a pair of voxels
_MOST_TIME = 2.5  # sweep intervals: t, t-1 and their jitter; older sweeps are ignored
_NUM_STEPS = 5
_STEP_LENGTH = 1.6  # of that of Gauss and Newton: nearest partners change with each step, so theirs falls short
_LONGEST_CORRECTION = 0.15  # metres per interval, in x and in y, from the given flow
_LARGEST_ROTATION = 0.1  # tangent of half the angle per interval
_HELD = 40.0  # perfect pairs of voxels that the given translation is worth
_HELD_ROTATION = 20.0  # perfect pairs at a distance of 1 m that no rotation is worth
# An object that covers a quarter of a turn of the sensor in an interval would be nearer than its own length. Times that
# differ by more are those of a place that is measured at the end of one sweep and at the start of the next.
_LEAST_STRETCH = 0.75


def register(points: ObjectPoints, sweeps: HeightSlicedSweeps, flow: Tensor) -> RigidMotion:
    """Refine the motion of every object by the voxels that meet under it, and estimate its rotation.

    Every voxel of another sweep is paired with the nearest one at t+1, every voxel of t+1 with the nearest one in each
    other sweep. A pair weighs less if its voxels are farther apart. Each step minimises the squared errors over
    translation and angle. Two more terms hold on to the given translation and to no rotation.

    Args:
        points: of the objects that move, of all sweeps; static points would take partners away.
        sweeps: finest images.
        flow: (G, 2) float64, x and y, metres per sweep interval, to start from.

    Returns:
        The motion. An object without points at t keeps its flow.

    Cost: nine lookups a step for each voxel and sweep.
    """
    given = torch.view_as_complex(flow * UNITS)
    pairs = _VoxelPairs(Voxels(points, sweeps, NUM_LAYERS), sweeps, len(flow))
    velocity, rotation = given, torch.zeros_like(flow[:, 0])
    for _ in range(_NUM_STEPS):
        velocity, rotation = _solve(given, velocity, rotation, pairs.normal_equations(velocity, rotation))
    corner = torch.tensor(sweeps.grid.lower[:2], dtype=torch.float64, device=flow.device)
    centre = torch.view_as_real(pairs.centre) / UNITS + corner
    return RigidMotion(torch.view_as_real(velocity) / UNITS, rotation, centre)


def stretch_of(points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion) -> Tensor:
    """Return the ratio of the time between two sightings of an object to the time between the sweeps.

    Args:
        points: of the objects that move, with times.
        sweeps: finest images.
        rigid: apparent motion of G objects: the result of `register`.

    Returns:
        (G,) float64: sum of w k (k + b - a) over the sum of w k^2, over all pairs of voxels; w is the weight of a pair,
        k the intervals between its sweeps, a and b the mean times of its voxels in intervals. So the motion divided by
        it explains the pairs best. 1 for objects without pairs, and where it is below 0.75.

    Convention: k is rounded to a 16th and b - a to a 1024th, halves up.
    """
    pairs = _VoxelPairs(Voxels(points, sweeps, NUM_LAYERS), sweeps, len(rigid.flow))
    velocity = torch.view_as_complex(rigid.flow.contiguous() * UNITS)
    squares, *_, late = pairs.normal_equations(velocity, rigid.rotation)
    stretch = torch.where(squares > 0, 1 + late / squares, torch.ones_like(squares))
    return torch.where(stretch < _LEAST_STRETCH, torch.ones_like(stretch), stretch)


class _VoxelPairs:
    """Voxels of G objects and the sweeps in which each is paired. The plane is that of complex numbers, in units.

    Attributes:
        centre: (G,) complex128, mean of the centroids at t, whole units.
    """

    def __init__(self, voxels: Voxels, sweeps: HeightSlicedSweeps, num_objects: int) -> None:
        self._voxels, self._num_objects = voxels, num_objects
        at_t = flat_nonzero(voxels.step == 1)
        place = F.pad(torch.view_as_real(voxels.place[at_t]).t(), (0, 0, 0, 1), value=1.0)
        *sums, count = scatter_count(voxels.owner[at_t], num_objects, place)
        self.centre = torch.complex(*(torch.floor(total / count.clamp(min=1)) for total in sums))
        since_t = (sweeps.elapsed[:, 1:2] - sweeps.elapsed).flatten()
        voxel, to = comparisons(voxels.step, sweeps.num_steps)
        window, step, owner = gather(voxel, voxels.window, voxels.step, voxels.owner)
        is_given = (sweeps.elapsed != 0).flatten().index_select(0, window * sweeps.num_steps + torch.maximum(step, to))
        start, end = (since_t.index_select(0, window * sweeps.num_steps + at) for at in (step, to))
        kept = flat_nonzero(is_given & ((end - start).abs() <= _MOST_TIME) & (count > 0).index_select(0, owner))
        voxel, self._owner, self._start, self._end, to, window = gather(kept, voxel, owner, start, end, to, window)
        self._sweep, self._voxel = window * sweeps.num_steps + to, voxel
        self._time = whole(16 * (self._end - self._start)) / 16
        self._owner_of_voxel = F.pad(voxels.owner, (0, 1), value=-1)
        self._weight = meeting_weights(_SIGMA, voxel.device)

    def normal_equations(self, velocity: Tensor, rotation: Tensor) -> Tensor:
        """Sums over the pairs of each object under a motion, (7 or 8, G) float64.

        They are those of w k^2, w k^2 |r|^2, w k (r x e), of x and y of w k^2 r and of w k e, and, where there are
        times, of w k (b - a): weight w, time k from one voxel to the other, arm r from the centre, error e in units,
        times a and b of the two voxels.

        Args:
            velocity: (G,) complex128, units per interval.
            rotation: (G,) float64, tangent of half the angle per interval.
        """
        motion = torch.stack((self.centre, velocity, rotation.to(velocity.dtype)))
        num_sums = 7 if self._voxels.time is None else 8
        total = motion.real.new_zeros((num_sums, self._num_objects))
        row = torch.arange(num_sums, device=rotation.device)[:, None] * self._num_objects
        for some in chunks(0, self._voxel.numel(), rotation.device, 9):
            owner = self._owner[some]
            terms = self._terms(some, owner, *motion.index_select(1, owner).unbind(0))
            total.view(-1).index_add_(0, (owner + row).view(-1), terms.view(-1))
        return total

    def _terms(self, some: slice, owner: Tensor, centre: Tensor, velocity: Tensor, rotation: Tensor) -> Tensor:
        """(7 or 8, K) summands of some comparisons."""
        voxels, voxel, start, end = self._voxels, self._voxel[some], self._start[some], self._end[some]
        k = self._time[some]
        arm = rotate(rotation.real * (end - start), voxels.place.index_select(0, voxel) - centre - velocity * start)
        target = whole(centre + velocity * end + arm)
        other = voxels.nearest(self._sweep[some], voxels.part.index_select(0, voxel), target)
        is_pair = self._owner_of_voxel.index_select(0, other) == owner
        # Where nothing is met, errors are huge; the weight is 0 there.
        error, arm = (voxels.place.index_select(0, other) - target) * is_pair, whole(arm) * is_pair
        square = square_of(error).div_(64).clamp_(max=2048).long()
        w = self._weight.index_select(0, square) * is_pair
        wk = w * k
        wkk, cross = wk * k, (arm.conj() * error).imag
        real = torch.stack((wkk, wkk * square_of(arm), wk * cross))
        terms = [real, *(torch.view_as_real(z).t() for z in (wkk * arm, wk * error))]
        if voxels.time is not None:
            late = (lookup(voxels.time, other) - voxels.time.index_select(0, voxel)) * is_pair
            terms.append((wk * (whole(UNITS * late) / UNITS))[None])
        return torch.cat(terms)


def _solve(given: Tensor, velocity: Tensor, rotation: Tensor, sums: Tensor) -> tuple[Tensor, Tensor]:
    """The motion after a Gauss-Newton step; the equations are solved by elimination.

    Args:
        given: (G,) complex128, velocity that is held on to, units.
        velocity, rotation: of G objects, as for `normal_equations`.
        sums: as `normal_equations` gives them.
    """
    s, squares, moment = sums[:3]
    arm, error = torch.complex(*sums[3:5]), torch.complex(*sums[5:7])
    held_rotation = _HELD_ROTATION * UNITS**2
    s, force = s + _HELD, error + _HELD * (given - velocity)
    moment = moment - held_rotation * (2 * rotation)
    angle = (moment - (arm.conj() * force).imag / s) / (squares + held_rotation - square_of(arm) / s)
    moved = torch.view_as_real(velocity + _STEP_LENGTH * (force - 1j * arm * angle) / s)
    start, longest = torch.view_as_real(given), _LONGEST_CORRECTION * UNITS
    moved = torch.clamp(moved, start - longest, start + longest)
    rotation = (rotation + _STEP_LENGTH * angle / 2).clamp(-_LARGEST_ROTATION, _LARGEST_ROTATION)
    return torch.view_as_complex(moved), rotation
