"""Refinement of the motion of groups: a few Gauss-Newton steps on the centroids of their voxels, all groups at once."""

from __future__ import annotations

import math
from typing import NamedTuple, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.moving import MovingPoints
from cflow_torch.verified.rigid import RigidMotion, rotate
from cflow_torch.verified.voxel_centroids import UNITS, Voxels, make_voxels
from cflow_torch.windows.bev_grid import Grid

# Tried on five data sets and on simulated drives (docs/beyond.md). What holds the translation keeps pedestrians from
# sliding along their few points; older sweeps than these pull where an object does not turn at a constant rate.
_SIGMA = 0.15  # metres, of the weight of a pair of voxels
_MOST_TIME = 2.5  # sweep intervals: t, t-1 and their jitter; older sweeps are not looked at
_NUM_STEPS = 4
_LONGEST_WAY = 0.15  # metres per interval, in x and in y, from the given flow
_LARGEST_TURN = 0.1  # tangent of half the angle per interval
_HELD = 150.0  # perfect pairs of voxels that the given translation is worth
_HELD_SHARE = 0.2  # and, besides, this share of the pairs that were found
_HELD_TURN = 20.0  # perfect pairs at a distance of 1 m that no turn is worth
_ONE = 256  # weight of a perfect pair


def refine(
    points: MovingPoints,
    pixel_of_place: Tensor,
    num_pixels: int,
    grid: Grid,
    elapsed: Tensor,
    flow: Tensor,
    turns: bool = True,
) -> RigidMotion:
    """Refine the motion of every group by the voxels that find each other under it.

    Every voxel before t+1 looks for the nearest one at t+1, every voxel of t+1 for the nearest one in each earlier
    sweep. A pair weighs the less the farther it is from meeting. Least squares over translation and angle, with squares
    that hold on to the given translation and to no turn; the motion that results is where the next step starts.

    Args:
        points: of the groups that move, of all sweeps; what stands still would take partners away.
        pixel_of_place, num_pixels, grid: as for `make_voxels`.
        elapsed: (B, S) float64, sweep intervals from each sweep to t+1.
        flow: (G, 2) float64, x and y, metres per sweep interval, to start from.
        turns: False = the groups do not turn.

    Returns:
        The motion. A group without points at t keeps its flow; its centre is the lower corner.

    Convention: of the start and the steps that follow, the one whose pairs weigh most counts, of equals the first.

    Cost: five times nine look-ups for each voxel and sweep that is looked at. Sums are of integers; the rest is
        elementwise float64.
    """
    voxels = make_voxels(points, pixel_of_place, num_pixels, grid, elapsed.shape[1])
    groups = _Groups(voxels, elapsed, flow, turns)
    way, turn = groups.given, torch.zeros_like(flow[:, 0])
    best_way, best_turn, most = way, turn, torch.full_like(groups.centre[0], -1)
    for step in range(_NUM_STEPS + 1):
        score, sums = groups.look(way, turn)
        is_better = score > most
        most = torch.maximum(score, most)
        best_way, best_turn = torch.where(is_better, way, best_way), torch.where(is_better, turn, best_turn)
        if step < _NUM_STEPS:
            way, turn = groups.step(way, turn, sums)
    corner = torch.tensor(grid.lower[:2], dtype=torch.float64, device=flow.device)
    return RigidMotion(best_way.t() / UNITS, best_turn, groups.centre.t().double() / UNITS + corner)


class _Sums(NamedTuple):
    """Normal equations, (G,) int64 each, times in 1/16 intervals: s_xy = high * 2^20 + low, too long for one number."""

    s: Tensor
    s_x: Tensor
    s_y: Tensor
    high: Tensor
    low: Tensor
    e_x: Tensor
    e_y: Tensor
    e_a: Tensor


class _Groups:
    """G groups and what their voxels look for."""

    def __init__(self, voxels: Voxels, elapsed: Tensor, flow: Tensor, turns: bool) -> None:
        self.voxels, self.turns, self.num = voxels, turns, len(flow)
        self.given = flow.t().contiguous() * UNITS  # (2, G)
        at_t = flat_nonzero(voxels.step == 1)
        of_t = voxels.group.index_select(0, at_t)
        count = self._add(of_t, torch.ones_like(of_t))
        x, y = (self._add(of_t, values[:-1].index_select(0, at_t)) for values in (voxels.x, voxels.y))
        self.centre = torch.div(torch.stack((x, y)), count.clamp(min=1), rounding_mode="floor")  # (2, G) int64

        num_steps = voxels.num_steps
        looks = (count > 0).index_select(0, voxels.group)
        older, newest = flat_nonzero(looks & (voxels.step > 0)), flat_nonzero(looks & (voxels.step == 0))
        voxel = torch.cat((older, newest.repeat(num_steps - 1)))
        back = torch.arange(1, num_steps, device=older.device).repeat_interleave(newest.numel())
        sweep = torch.cat((voxels.step.index_select(0, older), back))
        image = voxels.window.index_select(0, voxel) * num_steps + sweep
        time = elapsed.flatten().index_select(0, image)
        kept = flat_nonzero((time > 0) & (time <= _MOST_TIME))
        self._voxel, self._time = voxel.index_select(0, kept), time.index_select(0, kept)
        self._is_back = kept >= older.numel()
        self._sweep = torch.where(self._is_back, sweep.index_select(0, kept), 0)  # where it looks
        self._group = voxels.group.index_select(0, self._voxel)
        self._window, self._part = (v.index_select(0, self._voxel) for v in (voxels.window, voxels.part))
        table = [*(int(_ONE * math.exp(-(64 * i + 32) / (2 * (_SIGMA * UNITS) ** 2)) + 0.5) for i in range(2048)), 0]
        self._weight = torch.tensor(table, device=flow.device)  # of squared distances in steps of 64 units

    def look(self, way: Tensor, turn: Tensor) -> Tuple[Tensor, _Sums]:
        """(G,) int64 weight of the pairs that are found under a motion, and their normal equations.

        Args:
            way: (2, G) float64, units per interval.
            turn: (G,) float64.
        """
        total = torch.zeros((9, self.num), dtype=torch.int64, device=way.device)
        for some in chunks(0, self._voxel.numel(), way.device, 9):
            total += self._look(some, way, turn)
        score, *sums = total.unbind(0)
        return score, _Sums(*sums)

    def _look(self, some: slice, way: Tensor, turn: Tensor) -> Tensor:
        """(9, G) int64, the same of some looks: weight, then `_Sums`."""
        voxels, group, time, is_back = self.voxels, self._group[some], self._time[some], self._is_back[some]
        voxel = self._voxel[some]
        c_x, c_y = self.centre.index_select(1, group).double().unbind(0)
        k_x, k_y = (time * values for values in way.index_select(1, group).unbind(0))
        turn = turn.index_select(0, group) * time
        x, y = (v.index_select(0, voxel).double() for v in (voxels.x, voxels.y))
        on_x, on_y = rotate(turn, x - c_x, y - c_y)
        back_x, back_y = rotate(-turn, x - c_x - k_x, y - c_y - k_y)
        to_x = _whole(torch.where(is_back, back_x + c_x, on_x + c_x + k_x))
        to_y = _whole(torch.where(is_back, back_y + c_y, on_y + c_y + k_y))
        other = voxels.nearest(self._window[some], self._sweep[some], self._part[some], to_x, to_y)

        found = flat_nonzero(other < voxels.group.numel())
        is_own = voxels.group.index_select(0, other.index_select(0, found)) == group.index_select(0, found)
        found = found.index_select(0, flat_nonzero(is_own))
        other, mine, is_back = (v.index_select(0, found) for v in (other, voxel, is_back))
        earlier, later = torch.where(is_back, other, mine), torch.where(is_back, mine, other)
        group, time, turn, c_x, c_y, k_x, k_y = (
            v.index_select(0, found) for v in (group, time, turn, c_x, c_y, k_x, k_y)
        )
        x, y = (v.index_select(0, earlier).double() for v in (voxels.x, voxels.y))
        r_x, r_y = rotate(turn, x - c_x, y - c_y)
        e_x = voxels.x.index_select(0, later) - _whole(r_x + c_x + k_x)
        e_y = voxels.y.index_select(0, later) - _whole(r_y + c_y + k_y)
        return self._normal_equations(group, _whole(time * 16), _whole(r_x), _whole(r_y), e_x, e_y)

    def _normal_equations(self, group: Tensor, k: Tensor, r_x: Tensor, r_y: Tensor, e_x: Tensor, e_y: Tensor) -> Tensor:
        w = self._weight.index_select(0, ((e_x * e_x + e_y * e_y) >> 6).clamp_(max=2048))
        wk = w * k
        wkk = wk * k
        s_xy = wkk * (r_x * r_x + r_y * r_y)
        e_a = wk * (r_x * e_y - r_y * e_x)
        terms = (w, wkk, wkk * r_x, wkk * r_y, s_xy >> 20, s_xy & ((1 << 20) - 1), wk * e_x, wk * e_y, e_a)
        return torch.stack([self._add(group, term) for term in terms])

    def step(self, way: Tensor, turn: Tensor, sums: _Sums) -> Tuple[Tensor, Tensor]:
        """The motion after a Gauss-Newton step: the equations are solved by elimination, in this order."""
        s, s_x, s_y, high, low, e_x, e_y, e_a = (values.double() for values in sums)
        held = _HELD_SHARE * (s / _ONE) + _HELD * _ONE
        held_turn = _HELD_TURN * _ONE * UNITS * UNITS
        a, a_x, a_y = s / _ONE + held, s_x / _ONE, -s_y / _ONE
        a_xy = (high * (1 << 20) + low) / _ONE + held_turn  # rounds once, as one number would
        b_x = e_x / 16 + held * (self.given[0] - way[0])
        b_y = e_y / 16 + held * (self.given[1] - way[1])
        b_a = e_a / 16 - held_turn * (2 * turn)
        angle = (b_a - (a_y * b_x + a_x * b_y) / a) / (a_xy - (a_y * a_y + a_x * a_x) / a)
        angle = angle if self.turns else torch.zeros_like(angle)
        moved = way + torch.stack(((b_x - a_y * angle) / a, (b_y - a_x * angle) / a))
        longest = _LONGEST_WAY * UNITS
        moved = torch.minimum(torch.maximum(moved, self.given - longest), self.given + longest)
        return moved, (turn + angle / 2).clamp(-_LARGEST_TURN, _LARGEST_TURN)

    def _add(self, group: Tensor, values: Tensor) -> Tensor:
        """(G,) int64 sums of (K,) integers."""
        return torch.zeros(self.num, dtype=torch.int64, device=values.device).index_add_(0, group, values)


def _whole(x: Tensor) -> Tensor:
    """Nearest integer, halves up, int64."""
    return torch.floor(x + 0.5).long()
