"""Centroids of small cubes of groups, and how much better they meet those of the other sweep when they are shifted."""

from __future__ import annotations

import math
from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.ops.exact import exact_sqrt
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.paired_test import choose
from cflow_torch.verified.voxel_centroids import UNITS, Voxels

_SIGMA = 0.07  # metres, of the weight of two centroids
_AROUND = 2  # pixels in which a cube looks for others
_FARTHEST = 1 << 14  # units; twice its square fits an int32
_BLOCK = 410  # units, side of the blocks that vote
_ONE = 256  # weight of a perfect meeting


class Cubes:
    """Cubes of t and t+1 of G groups, and what they gain by a shift."""

    def __init__(self, voxels: Voxels, start: Tensor) -> None:
        num_groups = len(start)
        cube = flat_nonzero(voxels.step < 2)
        step = voxels.step.index_select(0, cube)
        window, part, x, y = (
            values.index_select(0, cube) for values in (voxels.window, voxels.part, voxels.x, voxels.y)
        )
        self._group, self._num_groups = voxels.group.index_select(0, cube), num_groups
        way = start.index_select(0, self._group) * (2 * step - 1)[:, None]
        x, y = x + way[:, 0], y + way[:, 1]
        near = voxels.around(window, 1 - step, part, x, y, _AROUND)
        # What a shift from t to t+1 leaves to go: seen from t+1 all signs change. No cube is far away.
        self._x, self._y = (
            values.int().index_select(0, near.view(-1)).view_as(near).sub_(own.int()).clamp_(-_FARTHEST, _FARTHEST)
            for values, own in ((voxels.x, x), (voxels.y, y))
        )
        sign = (2 * step - 1).int()
        self._x, self._y = self._x.mul_(sign), self._y.mul_(sign)
        self._place = torch.stack((x, y))
        self.count = torch.bincount(self._group, minlength=num_groups)
        table = [*(int(_ONE * math.exp(-(64 * i + 32) / (2 * (_SIGMA * UNITS) ** 2)) + 0.5) for i in range(2048)), 0]
        self._weight = torch.tensor(table, device=voxels.x.device)  # of squared distances in steps of 64 units
        self._at_rest = self._meet(torch.zeros((1, 2), dtype=torch.int32, device=x.device))

    def best_shift(self, reach: int, step: int, z: float, least_gain: int, least_cubes: int) -> Tuple[Tensor, Tensor]:
        """The shift of each group that is proved best.

        Args:
            reach: steps, in x and in y.
            step: units.
            z: standard deviations of luck that a shift is granted.
            least_gain: a shift must gain so many 40ths of a perfect meeting per cube.
            least_cubes: of a group.

        Returns:
            shift: (G, 2) int64, (x, y), units.
            proved: (G,) bool, False = the shift is 0.

        Convention: shifts in raster order; of equally proved ones the first.
        """
        line = torch.arange(-reach, reach + 1, device=self.count.device) * step
        shifts = torch.stack((line.repeat(len(line)), line.repeat_interleave(len(line))), 1)
        gain, square = self.gains(shifts[:, None])
        worth = (16 * (gain.double() - z * exact_sqrt(square.double()))).floor_().long().clamp_(min=0)
        count = self.count[:, None]
        worth = worth.masked_fill_((gain * 40 < count * (_ONE * least_gain)) | (count < least_cubes), 0)
        best, worth = choose(worth, shifts.double().expand(self._num_groups, -1, 2))
        return best.long(), worth > 0

    def gains(self, shifts: Tensor) -> Tuple[Tensor, Tensor]:
        """Weight that every cube gains by a shift, and its square, summed over the cubes of each group.

        Args:
            shifts: (C, G or 1, 2) int64, (x, y), units, from t to t+1.

        Returns:
            gain, square: (G, C) int64.

        Convention: a cube of t that is moved by the shift looks for the nearest one of t+1, one of t+1 that is moved
            back for the nearest of t, among those in the 5 x 5 pixels around it.
        """
        sums = torch.zeros((2, len(shifts), self._num_groups), dtype=torch.int64, device=shifts.device)
        for total, square, shift in zip(sums[0], sums[1], shifts.int()):
            own = shift if len(shift) == 1 else shift.index_select(0, self._group)
            gain = self._meet(own) - self._at_rest
            total.index_add_(0, self._group, gain)
            square.index_add_(0, self._group, gain * gain)
        return sums[0].t(), sums[1].t()

    def heed(self, shift: Tensor, proved: Tensor) -> None:
        """Put aside the cubes of blocks that do not gain by the shift of their group, and all of unproved groups.

        Args:
            shift: (G, 2) int64, as for `gains`.
            proved: (G,) bool.
        """
        self._take(flat_nonzero(proved.index_select(0, self._group)))
        gain = self._meet(shift.int().index_select(0, self._group)) - self._at_rest
        block = torch.div(self._place, _BLOCK, rounding_mode="floor")
        key = torch.cat((self._group[None], block)).t()
        number = torch.unique(key, dim=0, return_inverse=True)[1]
        total = torch.zeros_like(self._group).index_add_(0, number, gain)
        self._take(flat_nonzero(total.index_select(0, number) > 0))

    def _take(self, kept: Tensor) -> None:
        self._x, self._y, self._place = (values.index_select(1, kept) for values in (self._x, self._y, self._place))
        self._group, self._at_rest = (values.index_select(0, kept) for values in (self._group, self._at_rest))
        self.count = torch.bincount(self._group, minlength=self._num_groups)

    def _meet(self, shift: Tensor) -> Tensor:
        """(K,) int64 weight of what each cube meets at its shift, (K or 1, 2) int32."""
        x, y = self._x - shift[:, 0], self._y - shift[:, 1]
        distance = x.mul_(x).add_(y.mul_(y)).amin(0)
        return self._weight.index_select(0, (distance >> 6).clamp_(max=2048))
