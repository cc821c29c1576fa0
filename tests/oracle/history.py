"""Oracle of Sec. leverage_past_pcs: combine the estimates of several sweeps by medians."""

from __future__ import annotations

import math
from statistics import median
from typing import Sequence

import numpy as np


def pool(estimates: Sequence[np.ndarray]) -> np.ndarray:
    """Median of the magnitudes and of the orientations, separately (Sec. leverage_past_pcs).

    Args:
        estimates: at least one estimate of f_{t -> t+1}, (3,) float64 each, nearest sweep first.

    Returns:
        (3,) float64; z is the median of the z components.

    Convention:
        One estimate is returned unchanged. Even number: the mean of the middle two. Estimates of length 0 count among
        the magnitudes, but have no orientation; if all have length 0 the result is (0, 0). The median orientation is
        taken about the circular mean. If opposite estimates cancel it, it is taken about the nearest one.
    """
    if len(estimates) == 1:
        return np.array(estimates[0], dtype=np.float64)
    magnitudes, directions = [], []
    for f_x, f_y, _ in (estimate.tolist() for estimate in estimates):
        magnitude = math.sqrt(f_x * f_x + f_y * f_y)
        magnitudes.append(magnitude)
        if magnitude > 0:
            directions.append((f_x / magnitude, f_y / magnitude))
    magnitude = median(magnitudes)
    u_x, u_y = median_direction(directions) if directions else (0.0, 0.0)
    return np.array([magnitude * u_x, magnitude * u_y, median([float(estimate[2]) for estimate in estimates])])


def median_direction(directions: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Angular median of unit vectors about their circular mean. Even number: the bisector of the middle two.

    Convention: equal angles keep the given order. If the middle two are exactly opposite, the first of them is taken.
    """
    mean_x, mean_y = 0.0, 0.0
    for u_x, u_y in directions:
        mean_x, mean_y = mean_x + u_x, mean_y + u_y
    if mean_x == 0 and mean_y == 0:
        mean_x, mean_y = directions[0]

    def angle(u: tuple[float, float]) -> float:
        """Angle from the mean to u, counter-clockwise."""
        return math.atan2(mean_x * u[1] - mean_y * u[0] + 0.0, mean_x * u[0] + mean_y * u[1])

    ordered = sorted(directions, key=angle)
    middle = len(ordered) // 2
    if len(ordered) % 2 == 1:
        return ordered[middle]
    first, second = ordered[middle - 1], ordered[middle]
    w_x, w_y = first[0] + second[0], first[1] + second[1]
    norm = math.sqrt(w_x * w_x + w_y * w_y)
    return (w_x / norm, w_y / norm) if norm > 0 else first
