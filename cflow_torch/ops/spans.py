"""Many runs of consecutive indices, one after the other."""

from __future__ import annotations

import torch
from torch import Tensor


def concat_ranges(start: Tensor, count: Tensor, total: int | None = None) -> Tensor:
    """start[0], start[0] + 1, ... (count[0] of them), start[1], start[1] + 1, ...

    Args:
        start: (R,) int64.
        count: (R,) int64, not negative.
        total: sum of `count`, if it is known on the host: saves a synchronisation.

    Returns:
        (total,) int64.
    """
    place = torch.repeat_interleave(start + count - count.cumsum(0), count, output_size=total)
    return place.add_(torch.arange(place.numel(), device=place.device))
