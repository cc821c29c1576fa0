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
from cflow_torch.verified.voxel_centroids import UNITS, ObjectPoints, Voxels, meeting_weights, whole

# Chosen with a look at five data sets and simulated drives (docs/benchmarks.md, model card). What holds the translation
# keeps pedestrians from sliding along their few points; older sweeps than these pull where an object does not turn at a
# constant rate.
_SIGMA = 0.15  # metres, of the weight of a pair of voxels
_MOST_TIME = 2.5  # sweep intervals: t, t-1 and their jitter; older sweeps are ignored
_NUM_STEPS = 6
_LONGEST_CORRECTION = 0.15  # metres per interval, in x and in y, from the given flow
_LARGEST_ROTATION = 0.1  # tangent of half the angle per interval
_HELD = 150.0  # perfect pairs of voxels that the given translation is worth
_HELD_SHARE = 0.2  # and, besides, this share of the pairs that were found
_HELD_ROTATION = 20.0  # perfect pairs at a distance of 1 m that no rotation is worth
# An object that covers a quarter of a turn of the sensor in an interval would be nearer than its own length. Times that
# differ by more are those of a place that is measured at the end of one sweep and at the start of the next.
_LEAST_STRETCH = 0.75


def register(points: ObjectPoints, sweeps: HeightSlicedSweeps, flow: Tensor) -> RigidMotion:
    """Refine the motion of every object by the voxels that meet under it, and estimate its rotation.

    Every voxel of another sweep is paired with the nearest one at t+1, every voxel of t+1 with the nearest one in each
    other sweep. A pair weighs the less the farther its voxels are apart. We minimise squares over translation and
    angle, with terms that hold on to the given translation and to no rotation; the next step starts from the result.

    Args:
        points: of the objects that move, of all sweeps; static points would take partners away.
        sweeps: finest images.
        flow: (G, 2) float64, x and y, metres per sweep interval, to start from.

    Returns:
        The motion. An object without points at t keeps its flow.

    Convention: of the start and the steps that follow, the one with the largest total weight. Ties: the earliest.

    Cost: seven times nine look-ups for each voxel and sweep.
    """
    given = flow.t().contiguous() * UNITS
    pairs = _VoxelPairs(Voxels(points, sweeps), sweeps, len(flow))
    translation, rotation = given, torch.zeros_like(given[0])
    best, most = torch.cat((translation, rotation[None])), torch.full_like(rotation, -1)
    for step in range(_NUM_STEPS + 1):
        weight, sums = pairs.normal_equations(translation, rotation)
        is_better = weight > most
        best = torch.where(is_better, torch.cat((translation, rotation[None])), best)
        most = torch.maximum(weight, most)
        if step < _NUM_STEPS:
            translation, rotation = _solve(given, translation, rotation, sums)
    corner = torch.tensor(sweeps.grid.lower[:2], dtype=torch.float64, device=flow.device)
    return RigidMotion(best[:2].t() / UNITS, best[2], pairs.centre.t() / UNITS + corner)


def stretch_of(points: ObjectPoints, sweeps: HeightSlicedSweeps, rigid: RigidMotion) -> Tensor:
    """By what factor the time between two sightings of an object is longer than that between the sweeps.

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
    pairs = _VoxelPairs(Voxels(points, sweeps), sweeps, len(rigid.flow))
    squares, *_, late = pairs.normal_equations(rigid.flow.t().contiguous() * UNITS, rigid.turn)[1]
    stretch = torch.where(squares > 0, 1 + late / squares, torch.ones_like(squares))
    return torch.where(stretch < _LEAST_STRETCH, torch.ones_like(stretch), stretch)


class _VoxelPairs:
    """Voxels of G objects and the sweeps in which each is paired.

    Attributes:
        centre: (2, G) float64, mean of the centroids at t, whole units.
    """

    def __init__(self, voxels: Voxels, sweeps: HeightSlicedSweeps, num_objects: int) -> None:
        self._voxels, self._num_objects = voxels, num_objects
        at_t = flat_nonzero(voxels.step == 1)
        sums = scatter_count(voxels.owner[at_t], num_objects, F.pad(voxels.place[:, at_t], (0, 0, 0, 1), value=1.0))
        self.centre = torch.floor(sums[:2] / sums[2].clamp(min=1))
        voxel, to = comparisons(voxels.step, sweeps.num_steps)
        window, step, owner = gather(voxel, voxels.window, voxels.step, voxels.owner)
        time = sweeps.elapsed.flatten().index_select(0, window * sweeps.num_steps + torch.maximum(step, to))
        kept = flat_nonzero((time != 0) & (time.abs() <= _MOST_TIME) & (sums[2] > 0).index_select(0, owner))
        sweep = window * sweeps.num_steps + to
        self._voxel, self._owner, self._time, self._sweep, to = gather(kept, voxel, owner, time, sweep, to)
        self._is_back, self._part = to > 0, voxels.part.index_select(0, self._voxel)
        self._weight = meeting_weights(_SIGMA, time.device)

    def normal_equations(self, translation: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
        """Total weight of the pairs under a motion, (G,) float64, and sums over them, (7 or 8, G) float64.

        The sums are those of w k^2, w k (r x e), w k^2 |r|^2, of w k^2 r, of w k e, and, where there are times, of
        w k (b - a): weight w, time k, arm r from the centre, error e in units, times a and b of the two voxels.

        Args:
            translation: (2, G) float64, units per interval.
            rotation: (G,) float64, tangent of half the angle per interval.
        """
        num_sums = 8 if self._voxels.time is None else 9
        total = torch.zeros((num_sums, self._num_objects), dtype=torch.float64, device=rotation.device)
        rows = torch.arange(num_sums, device=rotation.device)[:, None] * self._num_objects
        for some in chunks(0, self._voxel.numel(), rotation.device, 9):
            index = (self._owner[some] + rows).view(-1)
            total.view(-1).index_add_(0, index, self._terms(some, translation, rotation).view(-1))
        return total[0], total[1:]

    def _terms(self, some: slice, translation: Tensor, rotation: Tensor) -> Tensor:
        """(8 or 9, K) summands of some comparisons, the weight first."""
        voxels, voxel, owner = self._voxels, self._voxel[some], self._owner[some]
        time, is_back, own = self._time[some], self._is_back[some], voxels.place.index_select(1, voxel)
        centre = self.centre.index_select(1, owner)
        way, turn = translation.index_select(1, owner) * time, rotation.index_select(0, owner) * time
        # Forward: rotate, then move; back: move, then rotate.
        moved = rotate(torch.where(is_back, -turn, turn), own - centre - way * is_back)
        other = voxels.nearest(self._sweep[some], self._part[some], whole(moved + centre + way * ~is_back))
        is_pair = lookup(voxels.owner, other, -1) == owner

        met = voxels.place.index_select(1, other)
        earlier, later = torch.where(is_back, met, own), torch.where(is_back, own, met)
        arm, k = rotate(turn, earlier - centre), whole(16 * time) / 16
        # Where nothing is met, errors are huge; the weight is 0 there.
        error, arm = (later - whole(arm + centre + way)) * is_pair, whole(arm) * is_pair
        square = (error * error).sum(0).div_(64).clamp_(max=2048).long()
        w = self._weight.index_select(0, square) * is_pair / 256
        wk = w * k
        wkk, cross = wk * k, arm[0] * error[1] - arm[1] * error[0]
        terms = [torch.stack((w, wkk, wk * cross, wkk * (arm * arm).sum(0))), wkk * arm, wk * error]
        if voxels.time is not None:
            times = lookup(voxels.time, other), voxels.time.index_select(0, voxel)
            late = torch.where(is_back, times[1] - times[0], times[0] - times[1]) * is_pair
            terms.append((wk * (whole(UNITS * late) / UNITS))[None])
        return torch.cat(terms)


def _solve(given: Tensor, translation: Tensor, rotation: Tensor, sums: Tensor) -> tuple[Tensor, Tensor]:
    """The motion after a Gauss-Newton step; the equations are solved by elimination.

    Args:
        given: (2, G) float64, translation that is held on to, units.
        translation, rotation: of G objects, as for `normal_equations`.
        sums: as `normal_equations` gives them.
    """
    s, e_a, s_xy, s_x, s_y, e_x, e_y = sums[:7]
    held, held_rotation = _HELD_SHARE * s + _HELD, _HELD_ROTATION * UNITS**2
    a, a_x, a_y, a_xy = s + held, s_x, -s_y, s_xy + held_rotation
    b_x, b_y = torch.stack((e_x, e_y)) + held * (given - translation)
    b_a = e_a - held_rotation * (2 * rotation)
    angle = (b_a - (a_y * b_x + a_x * b_y) / a) / (a_xy - (a_y * a_y + a_x * a_x) / a)
    moved = translation + torch.stack(((b_x - a_y * angle) / a, (b_y - a_x * angle) / a))
    longest = _LONGEST_CORRECTION * UNITS
    moved = torch.minimum(torch.maximum(moved, given - longest), given + longest)
    return moved, (rotation + angle / 2).clamp(-_LARGEST_ROTATION, _LARGEST_ROTATION)
