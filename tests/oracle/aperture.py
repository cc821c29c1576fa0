"""The aperture problem: a line that seems to slide along itself has most likely not moved."""

from __future__ import annotations

import math
from typing import List, Sequence, Tuple

from oracle.height_slices import Pixel, SlicedSweeps, Vector


def slides_along_itself(sweeps: SlicedSweeps, members: Sequence[Pixel], candidates: Sequence[Vector]) -> List[bool]:
    """Which motions of a component are explained by a line that stays where it is.

    Returns:
        Of each candidate, whether the component is a line at t+1, the motion points along it and leads at least 1.2 m
        over the window, and the other sweeps see something all along it, or t+1 all along where it was.
    """
    is_line, axis_y, axis_x = principal_axis([(r, c) for m, r, c in members if m == 0], sweeps.pixel_size)
    stays = is_line and is_covered(sweeps, members)
    result = []
    for y, x in candidates:
        across, square = axis_y * x - axis_x * y, y * y + x * x
        # The sine of the angle between the two is at most 0.2.
        is_along = across * across <= 0.04 * square * (axis_y * axis_y + axis_x * axis_x)
        is_far = square * (max(sweeps.elapsed) - min(sweeps.elapsed)) ** 2 >= (1.2 / sweeps.pixel_size) ** 2
        result.append(stays and is_along and is_far)
    return result


def principal_axis(pixels: Sequence[Tuple[int, int]], pixel_size: float) -> Tuple[bool, float, float]:
    """Whether pixels lie along a line, and its direction (y, x), of any length.

    Convention: second moments; standard deviation at most 0.3 m across and at least 1 m along.
    """
    if not pixels:
        return False, 0.0, 0.0
    n, top, left = len(pixels), min(r for r, _ in pixels), min(c for _, c in pixels)
    y, x = [r - top for r, _ in pixels], [c - left for _, c in pixels]
    var_y = (n * sum(a * a for a in y) - sum(y) ** 2) / (n * n)
    var_x = (n * sum(a * a for a in x) - sum(x) ** 2) / (n * n)
    cov = (n * sum(a * b for a, b in zip(y, x)) - sum(y) * sum(x)) / (n * n)
    # Eigenvalues of the 2 x 2 matrix of moments; of its eigenvectors the one of the larger.
    mean, half = (var_y + var_x) / 2, (var_y - var_x) / 2
    root = math.sqrt(half * half + cov * cov)
    is_line = mean - root <= (0.3 / pixel_size) ** 2 and mean + root >= (1.0 / pixel_size) ** 2
    return (is_line, cov, mean + root - var_y) if var_y < var_x else (is_line, mean + root - var_x, cov)


def is_covered(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """At least 88 % of looks find something: of those from t+1 into all other sweeps, or of those from them into t+1.

    Convention: a look finds what lies in the same cell of about 0.4 m a side (whole pixels) or in one beside it.
    """
    side = max(1, round(0.4 / sweeps.pixel_size))
    cells = {(m, r // side, c // side) for m, r, c in sweeps.pixels()}
    forward, backward = [], []
    for m, r, c in members:
        for other in [0] if m > 0 else range(1, len(sweeps.images)):
            finds = any((other, r // side + dy, c // side + dx) in cells for dy in (-1, 0, 1) for dx in (-1, 0, 1))
            (forward if m > 0 else backward).append(finds)
    return any(sum(looks) * 100 >= len(looks) * 88 for looks in (forward, backward) if looks)
