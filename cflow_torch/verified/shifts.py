"""The distinct shifts of candidate motions, from each sweep to t+1 and from t+1 to each sweep, in whole pixels.

Candidates of a group are often alike: after rounding, they have the same shifts in all sweeps. We compare such motions
once, and motions that shift nothing not at all:

    motion, pixels per sweep interval     0.0    2.1    0.0    1.9    2.1   -1.0
    distinct shift                         -      0      -      0      0      1
    in the tables                         2.1   -1.0     .      .      .      .
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.verified.columns import NUM_SLICES
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_FAR = 2  # pixels in y or in x; for shifts of this length or more, absence is tested in the pixels around


class Shifts:
    """The shifts of C motions of M groups. Each distinct shift of a group has a number from 0 on.

    Args:
        window: (M,) int64.
        motions: (M, C, 2) float64, (y, x) finest pixels per sweep interval.
        is_wide: (M,) bool, the group has a reach of more than one pixel (`Spacing`).

    Attributes:
        count: (M,) int64, the number of distinct shifts of each group.
    """

    def __init__(self, sweeps: HeightSlicedSweeps, window: Tensor, motions: Tensor, is_wide: Tensor) -> None:
        self._num_steps = sweeps.num_steps
        elapsed = sweeps.elapsed_both_ways.index_select(1, window)  # [2, M, S]
        displacement = motions[:, None] * elapsed[..., None, None]  # [2, M, S, C, 2]
        pair = (displacement + 0.5).floor().int().view(torch.int64)[..., 0]  # [2, M, S, C], y and x as one number
        same = _first_equal(pair)  # [M, C]
        motion = torch.arange(1, motions.shape[1] + 1, device=motions.device)
        is_first = same == motion
        self.count = is_first.sum(1)
        number = is_first.cumsum(1) * is_first  # from 1 on; 0 = the motion shifts nothing, or another one is equal
        self._number = F.pad(number, (1, 0)).gather(1, same)  # of the shift of each motion, from 1 on; 0 = none
        motion_of_number = torch.zeros_like(F.pad(number, (1, 0))).scatter_(1, number, (motion - 1).expand_as(number))
        distinct = pair.gather(3, motion_of_number[:, None, 1:].expand_as(pair))
        self._shift = distinct.flatten(0, 2)[..., None].view(torch.int32)  # [2 M S, C, 2]
        is_far = torch.maximum(*self._shift.abs().unbind(2)) >= _FAR  # [2 M S, C]
        is_far |= is_wide[:, None].expand(2, -1, sweeps.num_steps).reshape(-1, 1)
        self._first_bit = is_far.view(torch.uint8) * NUM_SLICES

    def of(self, group: Tensor, from_step: Tensor, to_step: Tensor, count: int) -> tuple[Tensor, Tensor]:
        """Return the first c distinct shifts of n pixels, (n, c, 2) int32.

        Also return the first bit that tells absence at the target, (n, c) uint8. For far shifts and wide groups, we
        look in the pixels around, whose bits follow those of the pixel itself. Either step is 0. Numbers that a group
        does not have give some shift.
        """
        direction = (from_step == 0).long()
        row = (direction * len(self.count) + group) * self._num_steps + (from_step + to_step)  # [n]
        return self._shift[:, :count].index_select(0, row), self._first_bit[:, :count].index_select(0, row)

    def of_motions(self, values: Tensor) -> Tensor:
        """Give each motion the value of its shift: (R, M, C) to (R, M, C); 0 for motions that shift nothing."""
        return F.pad(values, (1, 0)).gather(2, self._number.expand_as(values))


def _first_equal(shift: Tensor) -> Tensor:
    """Return the first motion of the group with the same shifts, (M, C) int64, from 1 on; 0 = none of them shifts.

    `shift` is (2, M, S, C) int64.
    """
    of_motion = shift.permute(3, 0, 2, 1).flatten(1, 2)  # [C, R, M], because long rows are compared fast
    of_motion = F.pad(of_motion, (0, 0, 0, 0, 1, 0))  # motion 0 shifts nothing
    differs = (of_motion[1:, None] != of_motion).view(torch.uint8).amax(2)  # [C, 1 + C, M]
    motion = torch.arange(len(of_motion), dtype=torch.uint8, device=shift.device)[:, None]
    return torch.where(differs == 0, motion, 255).amin(1).t().long()
