"""What is made of the peak of the correlation beyond the paper (docs/beyond.md): a test, fractions of a pixel."""

from __future__ import annotations

from fractions import Fraction
from typing import Tuple

import numpy as np


def coinciding(template: np.ndarray, target: np.ndarray, dy: int, dx: int) -> np.ndarray:
    """Template pixels that fall on a target pixel when the template is moved.

    Args:
        template: (H, W) bool, or (n, H, W), one image per height slice.
        target: the same shape; pixels outside it are 0.
        dy, dx: shift in pixels.

    Returns:
        The same shape, bool, in the place of the template's pixels.
    """
    if template.ndim == 3:
        return np.stack([coinciding(*images, dy, dx) for images in zip(template, target)])
    height, width = template.shape
    result = np.zeros(template.shape, dtype=bool)
    for row, col in np.argwhere(template).tolist():
        there = row + dy, col + dx
        if 0 <= there[0] < height and 0 <= there[1] < width:
            result[row, col] = target[there]
    return result


def beats_zero(template: np.ndarray, target: np.ndarray, dy: int, dx: int, z: float) -> bool:
    """McNemar's test of a shift against no shift, over the template's pixels as pairs.

    Args:
        template, target, dy, dx: as for `coinciding`.
        z: used to two decimals.

    Returns:
        Whether b > c and (b - c) / sqrt(b + c) >= z, where b pixels coincide by the shift only, c without it only.
    """
    moved, still = coinciding(template, target, dy, dx), coinciding(template, target, 0, 0)
    b, c = int((moved & ~still).sum()), int((still & ~moved).sum())
    return b > c and (b - c) ** 2 >= Fraction(round(z * 100), 100) ** 2 * (b + c)


def parabola(template: np.ndarray, target: np.ndarray, dy: int, dx: int) -> Tuple[float, float]:
    """Top of the parabola through the counts at a shift and one pixel beside it, per axis.

    Args:
        template, target, dy, dx: as for `coinciding`.

    Returns:
        (y, x): pixels to add to the shift, each within half a pixel; 0 where the counts do not curve downwards.
    """

    def count(y: int, x: int) -> int:
        return int(coinciding(template, target, dy + y, dx + x).sum())

    offsets = []
    for y, x in ((1, 0), (0, 1)):
        low, top, high = count(-y, -x), count(0, 0), count(y, x)
        curve = 2 * top - low - high
        offsets.append(min(max((high - low) / (2 * curve), -0.5), 0.5) if curve > 0 else 0.0)
    return offsets[0], offsets[1]
