"""The aperture problem: a line that seems to slide along itself has most likely not moved."""

from __future__ import annotations

import math
from typing import Dict, List, Sequence, Set, Tuple

import numpy as np

Pixel = Tuple[int, int]


def slides_along_itself(
    component: Dict[int, Set[Pixel]],
    occupied: Dict[int, Set[Pixel]],
    intervals: float,
    candidates: np.ndarray,
    pixel_size: float,
) -> List[bool]:
    """Which motions of a component are explained by a line that stays where it is.

    Args:
        component: sweep (0 = t+1, 1 = t, ...) -> pixels (row, column) of the component.
        occupied: sweep -> all occupied pixels; a key for every sweep of the window, even an empty one.
        intervals: sweep intervals from the oldest sweep to t+1.
        candidates: (C, 2) float64 (y, x), pixels per sweep interval.
        pixel_size: s, metres.

    Returns:
        C times whether the component is a line, the motion points along it and leads far enough, and the other sweeps
        see something all along it.
    """
    is_line, axis_y, axis_x = principal_axis(sorted(component.get(0, set())), pixel_size)
    suspect = []
    for y, x in candidates.tolist():
        across = axis_y * x - axis_x * y
        square = y * y + x * x
        # The sine of the angle between the two is at most 0.2.
        along = across * across <= 0.04 * square * (axis_y * axis_y + axis_x * axis_x)
        suspect.append(is_line and along and square * (intervals * intervals) >= (1.2 / pixel_size) ** 2)
    return [one and _is_covered(component, occupied, pixel_size) for one in suspect]


def principal_axis(pixels: Sequence[Pixel], pixel_size: float) -> Tuple[bool, float, float]:
    """Whether pixels lie along a line, and its direction (y, x), of any length.

    Convention: second moments; standard deviation at most 0.3 m across and at least 1 m along.
    """
    n = float(max(len(pixels), 1))
    top, left = min([r for r, _ in pixels], default=0), min([c for _, c in pixels], default=0)
    y, x = [r - top for r, _ in pixels], [c - left for _, c in pixels]
    sum_y, sum_x = float(sum(y)), float(sum(x))
    var_y = (n * float(sum(a * a for a in y)) - sum_y * sum_y) / (n * n)
    var_x = (n * float(sum(a * a for a in x)) - sum_x * sum_x) / (n * n)
    cov = (n * float(sum(a * b for a, b in zip(y, x))) - sum_y * sum_x) / (n * n)
    mean, half = (var_y + var_x) / 2, (var_y - var_x) / 2
    root = math.sqrt(half * half + cov * cov)
    small, large = mean - root, mean + root
    is_line = small <= (0.3 / pixel_size) ** 2 and large >= (1.0 / pixel_size) ** 2
    return (is_line, cov, large - var_y) if var_y < var_x else (is_line, large - var_x, cov)


def _is_covered(component: Dict[int, Set[Pixel]], occupied: Dict[int, Set[Pixel]], pixel_size: float) -> bool:
    """At least 85 % of looks find something: from t+1 into every other sweep, from those into t+1.

    Convention: a look finds what lies in the same cell of about 0.4 m a side (whole pixels) or in one beside it.
    """
    side = max(1, round(0.4 / pixel_size))
    cells = {sweep: {(r // side, c // side) for r, c in pixels} for sweep, pixels in occupied.items()}
    looks = found = 0
    for sweep, pixels in component.items():
        for r, c in sorted(pixels):
            for other in occupied:
                if (sweep == 0) != (other == 0):
                    near = [(r // side + dy, c // side + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
                    looks += 1
                    found += any(cell in cells[other] for cell in near)
    return found * 100 >= looks * 85
