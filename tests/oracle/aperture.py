"""The aperture problem: lines that seem to slide along themselves, and long vehicles that really do."""

from __future__ import annotations

import math
from typing import Sequence

import numpy as np

from oracle.height_slices import Cell, Pixel, SlicedSweeps, Vector, count

LEAST_TRAVEL = 1.2  # metres
COVERED = 65  # per cent


def slides_along_itself(sweeps: SlicedSweeps, members: Sequence[Pixel], motion: Vector) -> bool:
    """Whether a line that stays where it is explains a motion of a component: it is a line at t+1 that is covered, or
    low and of a standard deviation of 2 m or more; and the motion points along it (the sine of the angle is at most
    0.2) and leads at least 1.2 m over the window."""
    newest = [(r, c) for m, r, c in members if m == 0]
    axis, speed = principal_axis(newest, sweeps.size), math.hypot(*motion)
    if axis is None or speed * (max(sweeps.elapsed) - min(sweeps.elapsed)) < LEAST_TRAVEL / sweeps.size:
        return False
    is_long = np.var(np.array(newest) @ axis) >= (2.0 / sweeps.size) ** 2
    is_rail = is_long and sum(count(sweeps.at(0, *cell)) for cell in newest) < 2 * len(newest)
    along = abs(axis[0] * motion[1] - axis[1] * motion[0]) <= 0.2 * speed
    return along and (is_rail or is_covered(sweeps, members))


def principal_axis(cells: Sequence[Cell], size: float) -> Vector | None:
    """Direction (y, x) of the line along which pixels lie: their standard deviation is at most 0.3 m across and at
    least 1 m along; None = they do not lie along one."""
    if not cells:
        return None
    (small, large), axes = np.linalg.eigh(np.cov(np.array(cells).T, bias=True))
    is_line = small <= (0.3 / size) ** 2 and large >= (1.0 / size) ** 2
    return tuple(axes[:, 1].tolist()) if is_line else None


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
    """Whether both ends of a component have moved in one direction along it since the sweep that is farthest from t+1.

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
    ends = []  # of each direction: how far it reaches at t+1, how far its first and its last pixel have moved
    for a, b, unit in ((1, 0, sweeps.size), (0, 1, sweeps.size), (1, 1, diagonal), (1, -1, diagonal)):
        now, then = ([a * r + b * c for r, c in cells] for cells in (newest, oldest))
        low, high = min(now) - min(then), max(now) - max(then)
        ends.append(((max(now) - min(now)) * unit, low * unit, high * unit))
    length, low_end, high_end = max(ends, key=lambda end: end[0])
    both = abs(low_end + high_end)
    is_tall = sum(count(sweeps.at(0, *cell)) for cell in newest) >= 2 * len(newest)
    return is_tall and length <= 60.0 and both >= 2 * LEAST_TRAVEL and abs(low_end - high_end) <= 0.1 * both
