"""Coverage: the azimuths in which each sweep measured.

A sensor may see a part of its surroundings only, and a sweep may lose packets. Where a sweep did not measure, it has no
points, but that does not mean that the place is empty.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import mark

_HALF = 90  # bins of each half of the circle, ahead and behind; a bin has 1.3 to 2.5 degrees
_CIRCLE = 2 * (_HALF + 1)  # the last bin of each half is the y axis
_SHORTEST = 16  # bins, 21 to 40 degrees; fewer empty bins in a row are a gap between objects


class Coverage:
    """Collects in which azimuths the sweeps of B windows have points, ground included.

    Args:
        num_windows: B.
        num_steps: S.
    """

    def __init__(self, num_windows: int, num_steps: int, device: torch.device) -> None:
        size = num_windows * num_steps
        self._shape = (num_windows, num_steps)
        self._has_points = torch.zeros((size, _CIRCLE + 1), dtype=torch.bool, device=device)  # see `_number`
        self._has_ground = torch.zeros(size + 1, dtype=torch.bool, device=device)  # the last one is of no sweep
        self._x_axis = torch.zeros((2, size), dtype=torch.float64, device=device)
        self._x_axis[0] = 1.0

    def add(self, image: int | Tensor, positions: Tensor, T_ego1_ego: Tensor | None, is_ground: Tensor) -> None:
        """Add N points of sweeps.

        Args:
            image: window * S + step, (N,) int32, or of all points.
            positions: (2, N) or (3, N) float64, metres, ego frame of the sweep.
            T_ego1_ego: (3, 4, N) float64, or (3, 4, 1) for all points; None = they are in the frame of t+1.
            is_ground: (N,) bool.
        """
        x, y = positions[:2].float()
        first = (_CIRCLE + 1) * image + _HALF + 1
        mark(self._has_points.view(-1), _number(x, y) + first)
        if isinstance(image, Tensor):
            mark(self._has_ground, torch.where(is_ground, image, len(self._has_ground) - 1).long())
        else:
            self._has_ground[image] |= torch.count_nonzero(is_ground) > 0  # `any` takes longer
        if T_ego1_ego is not None:
            self._x_axis[:, image] = T_ego1_ego[:2, 0] if isinstance(image, Tensor) else T_ego1_ego[:2, 0, 0]

    def has_gaps(self) -> bool:
        """Tell whether a sweep did not measure all around. Cost: a synchronisation."""
        return bool(self._unmeasured().any())

    def is_unmeasured(self, window: Tensor, offset: Tensor) -> Tensor:
        """Tell in which sweeps some directions were not measured.

        Args:
            window: (K,) int64.
            offset: (2, K, S) float64, metres, from the origin of the ego frame of each sweep, axes of t+1.

        Returns:
            (K, S) bool.

        Convention: not measured are 16 bins or more in a row without points. Sweeps without ground points measured
            everywhere, because their ground may have been cut out.
        """
        unmeasured = self._unmeasured()
        along_x, along_y = self._x_axis.view(2, *unmeasured.shape[:2]).index_select(1, window)  # [K, S] each
        x = along_x * offset[0] + along_y * offset[1]
        y = along_x * offset[1] - along_y * offset[0]
        number = _number(x, y)
        bins = (number - (number > 0).long()) % _CIRCLE
        return unmeasured.index_select(0, window).gather(2, bins[..., None])[..., 0]

    def _unmeasured(self) -> Tensor:
        """(B, S, bins) bool, around the circle from the right over ahead to the left and back."""
        behind, _, ahead = self._has_points.split((_HALF + 1, 1, _HALF + 1), 1)
        is_empty = ~torch.cat((ahead, behind), 1) & self._has_ground[:-1, None]
        is_empty = is_empty.view(*self._shape, _CIRCLE)
        begins = _all_of_next(is_empty, _SHORTEST)
        return ~_all_of_next(~begins, _SHORTEST).roll(_SHORTEST - 1, 2)


def _number(x: Tensor, y: Tensor) -> Tensor:
    """Return the numbers of the bins of vectors, int64.

    From the right to the left, they are 1 ... 91 ahead, and -1 ... -91 behind. 0 = the vector is 0 or not finite.
    """
    number = (y / (x.abs() + y.abs())).add_(1).mul_(_HALF / 2).add_(1)  # 1 ... 91
    return torch.copysign(number, x).nan_to_num_(0.0).long()


def _all_of_next(flags: Tensor, count: int) -> Tensor:
    """Tell which bins begin `count` True bins in a row, around the circle; flags are (B, S, bins)."""
    around = torch.cat((flags, flags[..., : count - 1]), 2)
    return F.max_pool1d((~around).float(), count, stride=1) == 0
