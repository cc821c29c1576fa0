"""Floating-point operations that round the same way everywhere."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

# Veltkamp's constant: splits a 53-bit significand into halves whose products are exact.
_SPLIT = 2.0**27 + 1


def exact_sqrt(x: Tensor) -> Tensor:
    """Square root, correctly rounded.

    `torch.sqrt` is not: on the CPU it goes through a vector library that is off by one unit in the last place for about
    1 in 70 numbers. Sums, products and quotients are correctly rounded on every device; this builds on them.

    Args:
        x: (...) float64, finite, 0 or between 1e-200 and 1e200.

    Returns:
        (...) float64, the double nearest to the square root.

    Cost: one pass on the CPU, by NumPy, whose root is the processor's; elsewhere some twenty elementwise operations.
    """
    if x.device.type == "cpu":
        return torch.from_numpy(np.asarray(np.sqrt(x.numpy())))  # asarray: of no dimension it would be a number
    return corrected_sqrt(x)


def corrected_sqrt(x: Tensor) -> Tensor:
    """`exact_sqrt` from the root that the device has, off by a unit in the last place or not. Same arguments."""
    root = x.sqrt()
    # x - root^2 without rounding error (Dekker's product): which neighbour of `root` is nearest?
    high = root * _SPLIT
    high = high - (high - root)
    low = root - high
    square = root * root
    error = ((high * high - square) + 2 * high * low) + low * low
    rest = (x - square) - error
    above = torch.nextafter(root, torch.full_like(root, float("inf")))
    below = torch.nextafter(root, torch.zeros_like(root))
    root_or_above = torch.where(rest > root * (above - root), above, root)
    return torch.where((x > 0) & (rest <= -root * (root - below)), below, root_or_above)
