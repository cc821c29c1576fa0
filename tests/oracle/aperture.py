"""The aperture problem: lines that seem to slide along themselves, and long vehicles that really do."""

from __future__ import annotations

import math
from typing import Sequence

from oracle.height_slices import Cell, Pixel, SlicedSweeps, Vector, count

LEAST_TRAVEL = 1.2  # metres
COVERED = 65  # per cent


def slides_along_itself(sweeps: SlicedSweeps, members: Sequence[Pixel], candidates: Sequence[Vector]) -> list[bool]:
    """Which motions of a component are explained by a line that stays where it is.

    Returns:
        Of each candidate, whether the component is a line at t+1, the motion points along it and leads at least 1.2 m
        over the window, and it is covered.
    """
    is_line, axis_y, axis_x = principal_axis([(r, c) for m, r, c in members if m == 0], sweeps.size)
    stays = is_line and is_covered(sweeps, members)
    result = []
    for y, x in candidates:
        across, square = axis_y * x - axis_x * y, y * y + x * x
        # The sine of the angle between the two is at most 0.2.
        is_along = across * across <= 0.04 * square * (axis_y * axis_y + axis_x * axis_x)
        is_far = square * (max(sweeps.elapsed) - min(sweeps.elapsed)) ** 2 >= (LEAST_TRAVEL / sweeps.size) ** 2
        result.append(stays and is_along and is_far)
    return result


def principal_axis(cells: Sequence[Cell], size: float) -> tuple[bool, float, float]:
    """Whether pixels lie along a line, and its direction (y, x), of any length.

    Convention: second moments; standard deviation at most 0.3 m across and at least 1 m along.
    """
    if not cells:
        return False, 0.0, 0.0
    n, y, x = len(cells), [r for r, _ in cells], [c for _, c in cells]
    var_y = (n * sum(a * a for a in y) - sum(y) ** 2) / (n * n)
    var_x = (n * sum(a * a for a in x) - sum(x) ** 2) / (n * n)
    cov = (n * sum(a * b for a, b in zip(y, x)) - sum(y) * sum(x)) / (n * n)
    # Eigenvalues of the 2 x 2 matrix of moments; of its eigenvectors the one of the larger.
    mean, half = (var_y + var_x) / 2, (var_y - var_x) / 2
    root = math.sqrt(half * half + cov * cov)
    is_line = mean - root <= (0.3 / size) ** 2 and mean + root >= (1.0 / size) ** 2
    return (is_line, cov, mean + root - var_y) if var_y < var_x else (is_line, mean + root - var_x, cov)


def is_covered(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """Whether slices are in the 3 x 3 pixels where they are, at least `COVERED` per cent: of those of t+1 in all other
    sweeps, or of those of the other sweeps in t+1."""
    found, total = [0, 0], [0, 0]
    for m, r, c in members:
        for other in sweeps.others(m):
            total[m == 0] += count(sweeps.at(m, r, c))
            found[m == 0] += count(sweeps.at(m, r, c) & sweeps.around(other, r, c))
    return any(all_ > 0 and near * 100 >= all_ * COVERED for near, all_ in zip(found, total))


def both_ends_move(sweeps: SlicedSweeps, members: Sequence[Pixel]) -> bool:
    """Whether both ends of a component have gone the same way along it since the sweep that is farthest from t+1.

    Convention: at least 1.2 m, alike to a tenth of their sum; and the pixels at t+1 have two height slices on average
        and are at most 60 m long. It lies along y, x or a diagonal, the one in which it reaches farthest at t+1. Ties:
        the first direction; of sweeps equally far the first.
    """
    newest = [(r, c) for m, r, c in members if m == 0]
    farthest = max(range(len(sweeps.images)), key=lambda m: abs(sweeps.elapsed[m]))
    oldest = [(r, c) for m, r, c in members if m == farthest]
    if not oldest:
        return False
    diagonal = math.sqrt(0.5) * sweeps.size
    ways = []  # of each direction: how far it reaches at t+1, how far its first and its last pixel have gone
    for a, b, unit in ((1, 0, sweeps.size), (0, 1, sweeps.size), (1, 1, diagonal), (1, -1, diagonal)):
        now, then = ([a * r + b * c for r, c in cells] for cells in (newest, oldest))
        low, high = min(now) - min(then), max(now) - max(then)
        ways.append(((max(now) - min(now)) * unit, low * unit, high * unit))
    length, low_way, high_way = max(ways, key=lambda way: way[0])
    both = abs(low_way + high_way)
    is_tall = sum(count(sweeps.at(0, *cell)) for cell in newest) >= 2 * len(newest)
    return is_tall and length <= 60.0 and both >= 2 * LEAST_TRAVEL and abs(low_way - high_way) <= 0.1 * both
