"""The distinct shifts of candidate motions, from each sweep to t+1 and from t+1 to each sweep, in whole pixels.

Candidates of a group are often alike: after rounding, they have the same shifts in all sweeps. We compare such motions
once, and motions that shift nothing not at all (on a CPU):

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
    """The shifts of C motions of M groups; C is below 2^15. Each distinct shift of a group has a number from 0 on.

    Args:
        window: (M,) int64.
        motions: (M, C, 2) float64, (y, x) finest pixels per sweep interval.
        is_wide: (M,) bool, the group has a reach of more than one pixel (`Spacing`).

    Attributes:
        count: (M,) int64, the number of distinct shifts of each group.
    """

    def __init__(self, sweeps: HeightSlicedSweeps, window: Tensor, motions: Tensor, is_wide: Tensor) -> None:
        self._num_steps = sweeps.num_steps
        to_newest = sweeps.elapsed.index_select(0, window)  # [M, S]
        elapsed = torch.stack((to_newest, -to_newest))  # [2, M, S], from each sweep to t+1, and from t+1 to each sweep
        displacement = motions[:, None] * elapsed[..., None, None]  # [2, M, S, C, 2]
        shift = (displacement + 0.5).floor().int().contiguous()
        pair = shift.view(torch.int64)[..., 0]  # [2, M, S, C], y and x as one number
        num_motions = motions.shape[1]
        self._number: Tensor | None = None  # motion c has shift c
        if num_motions > 1 and pair.device.type == "cpu":
            self.count, self._number, motion = _distinct(_first_equal(pair))
            pair = pair.gather(3, motion[:, None].expand_as(pair))
        else:  # on a GPU, the launches would cost more than the comparisons
            self.count = torch.full_like(window, num_motions)
        self._shift = pair.flatten(0, 2)[..., None].view(torch.int32)  # [2 M S, C, 2]
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
        return values if self._number is None else F.pad(values, (1, 0)).gather(2, self._number.expand_as(values))


def _distinct(same: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Number the distinct shifts of M groups.

        motion                               1    2    3    4    5    6
        pixels per sweep interval          0.0  2.1  0.0  1.9  2.1 -1.0
        same                                 0    2    0    2    2    6
        number of its shift                  0    1    0    1    1    2
        a motion of each shift, from 0 on    1    5    .    .    .    .

    Args:
        same: (M, C) int64, see `_first_equal`.

    Returns:
        count: (M,) int64, the number of distinct shifts of each group.
        number: (M, C) int64, the shift of each motion, from 1 on; 0 = the motion shifts nothing.
        motion: (M, C) int64, a motion with each shift, from 0 on; undefined beyond `count`.
    """
    motion = torch.arange(1, same.shape[1] + 1, device=same.device).expand_as(same)
    is_first = same == motion
    number_of_first = is_first.cumsum(1) * is_first  # 0 for motions that are not the first with their shift
    number = F.pad(number_of_first, (1, 0)).gather(1, same)
    motion_of_number = F.pad(torch.zeros_like(same), (1, 0)).scatter_(1, number_of_first, motion - 1)
    return is_first.sum(1), number, motion_of_number[:, 1:]


def _first_equal(shift: Tensor) -> Tensor:
    """Return the first motion of the group with the same shifts, (M, C) int64, from 1 on; 0 = none of them shifts.

    `shift` is (2, M, S, C) int64.
    """
    of_motion = shift.permute(3, 0, 2, 1).flatten(1, 2)  # [C, R, M], because long rows are compared fast
    nothing = torch.zeros_like(of_motion[:1])  # motion 0; torch 2.0 cannot pad if M = 0
    of_motion = torch.cat((nothing, of_motion))
    differs = (of_motion[1:, None] != of_motion).view(torch.uint8).amax(2)  # [C, 1 + C, M]
    motion = torch.arange(len(of_motion), dtype=torch.int16, device=shift.device)[:, None]
    return torch.where(differs == 0, motion, len(motion)).amin(1).t().long()
