"""The top of a parabola through three samples."""

from __future__ import annotations

import torch
from torch import Tensor


def vertex(low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
    """Where the parabola through three samples, one step apart, is largest, in steps from the middle.

    Args:
        low, middle, high: (...) of any type.

    Returns:
        (...) float64 within half a step; 0 where the samples do not curve downwards.
    """
    curve = (2 * middle - low - high).double()
    is_peak = curve > 0
    offset = (high - low).double() / torch.where(is_peak, 2 * curve, torch.ones_like(curve))
    return torch.where(is_peak, offset, torch.zeros_like(offset)).clamp(-0.5, 0.5)
