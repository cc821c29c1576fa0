"""Coverage: the azimuths in which each sweep measured.

A sensor may see a part of its surroundings only, and a sweep may lose packets. Where a sweep did not measure, it has no
points, but that does not mean that the place is empty.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.directions import azimuth_bin
from cflow_torch.ops.indices import mark

_NUM_BINS = 180  # of 1.3 to 2.5 degrees
_SHORTEST = 16  # bins, 20 to 40 degrees; fewer empty bins in a row are a gap between objects


class Coverage:
    """Collects in which azimuths the sweeps of B windows have points, ground included.

    Args:
        num_windows: B.
        num_steps: S.
    """

    def __init__(self, num_windows: int, num_steps: int, device: torch.device) -> None:
        self._shape = (num_windows, num_steps, _NUM_BINS)
        self._has_points = torch.zeros(num_windows * num_steps * _NUM_BINS, dtype=torch.bool, device=device)
        # The last flag is of no sweep.
        self._has_ground = torch.zeros(num_windows * num_steps + 1, dtype=torch.bool, device=device)

    def add(self, image: int | Tensor, offset: Tensor, is_ground: Tensor) -> None:
        """Add N points of sweeps.

        Args:
            image: window * S + step, (N,) int32, or of all points.
            offset: (2, N) float64, metres, from the origin of the ego frame of the sweep, axes of t+1.
            is_ground: (N,) bool.
        """
        x, y = offset.float()
        bins = azimuth_bin(x, y, _NUM_BINS)
        mark(self._has_points, bins + image * _NUM_BINS)
        if isinstance(image, Tensor):
            mark(self._has_ground, torch.where(is_ground, image.long(), len(self._has_ground) - 1))
        else:
            self._has_ground[image] |= is_ground.any()

    def unmeasured(self) -> Tensor:
        """Return the azimuths that sweeps did not measure: those of at least 16 bins in a row without points.

        Sweeps without ground points measured everywhere, because their ground may have been cut out.

        Returns:
            (B, S, bins) bool.
        """
        is_empty = ~self._has_points.view(self._shape) & self._has_ground[:-1].view(*self._shape[:2], 1)
        begins = _all_of_next(is_empty, _SHORTEST)
        return ~_all_of_next(~begins, _SHORTEST).roll(_SHORTEST - 1, 2)


def _all_of_next(flags: Tensor, count: int) -> Tensor:
    """Tell which bins begin `count` True bins in a row, around the circle; flags are (B, S, bins)."""
    around = torch.cat((flags, flags[..., : count - 1]), 2)
    return F.max_pool1d((~around).float(), count, stride=1) == 0
