"""Rigid registration: a few Gauss-Newton steps on the voxel centroids of objects, all objects at once."""

from __future__ import annotations

from typing import NamedTuple, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import RigidMotion, rotate
from cflow_torch.verified.voxel_centroids import UNITS, ObjectPoints, Voxels, meeting_weights, whole

# Tried on five data sets and on simulated drives (docs/verified.md). What holds the translation keeps pedestrians from
# sliding along their few points; older sweeps than these pull where an object does not turn at a constant rate.
_SIGMA = 0.15  # metres, of the weight of a pair of voxels
_MOST_TIME = 2.5  # sweep intervals: t, t-1 and their jitter; older sweeps are not looked at
_NUM_STEPS = 4
_LONGEST_WAY = 0.15  # metres per interval, in x and in y, from the given flow
_LARGEST_TURN = 0.1  # tangent of half the angle per interval
_HELD = 150.0  # perfect pairs of voxels that the given translation is worth
_HELD_SHARE = 0.2  # and, besides, this share of the pairs that were found
_HELD_TURN = 20.0  # perfect pairs at a distance of 1 m that no turn is worth


def register(points: ObjectPoints, sweeps: HeightSlicedSweeps, flow: Tensor) -> RigidMotion:
    """Refine the motion of every object by the voxels that find each other under it, and let it turn.

    Every voxel before t+1 looks for the nearest one at t+1, every voxel of t+1 for the nearest one in each earlier
    sweep. A pair weighs the less the farther it is from meeting. Least squares over translation and angle, with squares
    that hold on to the given translation and to no turn; the motion that results is where the next step starts.

    Args:
        points: of the objects that move, of all sweeps; what stands still would take partners away.
        sweeps: finest images.
        flow: (G, 2) float64, x and y, metres per sweep interval, to start from.

    Returns:
        The motion. An object without points at t keeps its flow.

    Convention: of the start and the steps that follow, the one whose pairs weigh most counts, of equals the first.

    Cost: five times nine look-ups for each voxel and sweep that is looked at.
    """
    pairs = _VoxelPairs(Voxels(points, sweeps), sweeps, flow.t().contiguous() * UNITS)
    way, turn = pairs.given, torch.zeros_like(flow[:, 0])
    best_way, best_turn, most = way, turn, torch.full_like(turn, -1)
    for step in range(_NUM_STEPS + 1):
        weight, sums = pairs.look(way, turn)
        is_better = weight > most
        most = torch.maximum(weight, most)
        best_way, best_turn = torch.where(is_better, way, best_way), torch.where(is_better, turn, best_turn)
        if step < _NUM_STEPS:
            way, turn = pairs.step(way, turn, sums)
    corner = torch.tensor(sweeps.grid.lower[:2], dtype=torch.float64, device=flow.device)
    return RigidMotion(best_way.t() / UNITS, best_turn, pairs.centre.t() / UNITS + corner)


class _Sums(NamedTuple):
    """Normal equations, (G,) float64 each: sums over pairs of weight w, time k, arm r, error e; lengths in units."""

    s: Tensor  # w k^2
    s_x: Tensor  # w k^2 r_x
    s_y: Tensor
    s_xy: Tensor  # w k^2 |r|^2
    e_x: Tensor  # w k e_x
    e_y: Tensor
    e_a: Tensor  # w k (r x e)


class _VoxelPairs:
    """Voxels of G objects and what they look for."""

    def __init__(self, voxels: Voxels, sweeps: HeightSlicedSweeps, given: Tensor) -> None:
        self.voxels, self.given, self.num = voxels, given, given.shape[1]
        at_t = flat_nonzero(voxels.step == 1)
        of_t = voxels.owner.index_select(0, at_t)
        count = torch.bincount(of_t, minlength=self.num)
        centre = [self._add(of_t, values[:-1].index_select(0, at_t)) for values in (voxels.x, voxels.y)]
        self.centre = torch.floor(torch.stack(centre) / count.clamp(min=1))  # (2, G)

        num_steps = sweeps.num_steps
        looks = (count > 0).index_select(0, voxels.owner)
        older, newest = flat_nonzero(looks & (voxels.step > 0)), flat_nonzero(looks & (voxels.step == 0))
        voxel = torch.cat((older, newest.repeat(num_steps - 1)))
        back = torch.arange(1, num_steps, device=older.device).repeat_interleave(newest.numel())
        step = torch.cat((voxels.step.index_select(0, older), back))
        time = sweeps.elapsed.flatten().index_select(0, voxels.window.index_select(0, voxel) * num_steps + step)
        kept = flat_nonzero((time != 0) & (time.abs() <= _MOST_TIME))
        self._voxel, self._time = voxel.index_select(0, kept), time.index_select(0, kept)
        self._is_back = kept >= older.numel()
        self._step = torch.where(self._is_back, step.index_select(0, kept), 0)  # where it looks
        self._owner = voxels.owner.index_select(0, self._voxel)
        self._weight = meeting_weights(_SIGMA, given.device)

    def look(self, way: Tensor, turn: Tensor) -> Tuple[Tensor, _Sums]:
        """(G,) float64 weight of the pairs that are found under a motion, and their normal equations.

        Args:
            way: (2, G) float64, units per interval.
            turn: (G,) float64.
        """
        total = torch.zeros((8, self.num), dtype=torch.float64, device=way.device)
        for some in chunks(0, self._voxel.numel(), way.device, 9):
            self._look(some, way, turn, total)
        weight, *sums = total.unbind(0)
        return weight, _Sums(*sums)

    def _look(self, some: slice, way: Tensor, turn: Tensor, total: Tensor) -> None:
        """Add those of some looks to (8, G) sums."""
        voxels, voxel, owner = self.voxels, self._voxel[some], self._owner[some]
        time, is_back = self._time[some], self._is_back[some]
        c_x, c_y = self.centre.index_select(1, owner).unbind(0)
        k_x, k_y = (time * values for values in way.index_select(1, owner).unbind(0))
        turn = turn.index_select(0, owner) * time
        x, y = voxels.x.index_select(0, voxel), voxels.y.index_select(0, voxel)
        on_x, on_y = rotate(turn, x - c_x, y - c_y)
        back_x, back_y = rotate(-turn, x - c_x - k_x, y - c_y - k_y)
        to_x = whole(torch.where(is_back, back_x + c_x, on_x + c_x + k_x))
        to_y = whole(torch.where(is_back, back_y + c_y, on_y + c_y + k_y))
        window, part = voxels.window.index_select(0, voxel), voxels.part.index_select(0, voxel)
        other = voxels.nearest(window, self._step[some], part, to_x, to_y)

        found = flat_nonzero(other < voxels.owner.numel())
        is_own = voxels.owner.index_select(0, other.index_select(0, found)) == owner.index_select(0, found)
        found = found.index_select(0, flat_nonzero(is_own))
        other, mine, is_back = (values.index_select(0, found) for values in (other, voxel, is_back))
        earlier, later = torch.where(is_back, other, mine), torch.where(is_back, mine, other)
        owner, k, turn, c_x, c_y, k_x, k_y = (
            values.index_select(0, found) for values in (owner, time, turn, c_x, c_y, k_x, k_y)
        )
        r_x, r_y = rotate(turn, voxels.x.index_select(0, earlier) - c_x, voxels.y.index_select(0, earlier) - c_y)
        e_x = voxels.x.index_select(0, later) - whole(r_x + c_x + k_x)
        e_y = voxels.y.index_select(0, later) - whole(r_y + c_y + k_y)
        r_x, r_y, k = whole(r_x), whole(r_y), whole(16 * k) / 16
        w = self._weight.index_select(0, ((e_x * e_x + e_y * e_y) / 64).long().clamp_(max=2048)) / 256
        wk = w * k
        wkk = wk * k
        e_a = wk * (r_x * e_y - r_y * e_x)
        terms = (w, wkk, wkk * r_x, wkk * r_y, wkk * (r_x * r_x + r_y * r_y), wk * e_x, wk * e_y, e_a)
        for out, term in zip(total, terms):
            out.index_add_(0, owner, term)

    def step(self, way: Tensor, turn: Tensor, sums: _Sums) -> Tuple[Tensor, Tensor]:
        """The motion after a Gauss-Newton step: the equations are solved by elimination."""
        held = _HELD_SHARE * sums.s + _HELD
        a, a_x, a_y = sums.s + held, sums.s_x, -sums.s_y
        held_turn = _HELD_TURN * UNITS**2
        a_xy = sums.s_xy + held_turn
        b_x = sums.e_x + held * (self.given[0] - way[0])
        b_y = sums.e_y + held * (self.given[1] - way[1])
        b_a = sums.e_a - held_turn * (2 * turn)
        angle = (b_a - (a_y * b_x + a_x * b_y) / a) / (a_xy - (a_y * a_y + a_x * a_x) / a)
        moved = way + torch.stack(((b_x - a_y * angle) / a, (b_y - a_x * angle) / a))
        longest = _LONGEST_WAY * UNITS
        moved = torch.minimum(torch.maximum(moved, self.given - longest), self.given + longest)
        return moved, (turn + angle / 2).clamp(-_LARGEST_TURN, _LARGEST_TURN)

    def _add(self, of_value: Tensor, values: Tensor) -> Tensor:
        """(G,) float64 sums of (K,) values."""
        return torch.zeros(self.num, dtype=values.dtype, device=values.device).index_add_(0, of_value, values)
