"""The aperture problem: lines that seem to slide along themselves, and long vehicles that really do."""

from __future__ import annotations

import math

import numpy as np

from oracle.height_slices import COUNT, SlicedSweeps, Vector
from oracle.paired_test import found_in_place

LEAST_TRAVEL = 1.2  # metres
COVERED = 65  # per cent


def slides_along_itself(sweeps: SlicedSweeps, members: np.ndarray, motion: Vector) -> bool:
    """Whether a line that stays where it is explains a motion of a component: it is a line at t+1 that is low and of a
    standard deviation of 2 m or more, or covered without both of its ends moving (in pairs, whatever they do); and the
    motion points along it (the sine of the angle is at most 0.2)."""
    newest = members[sweeps.pixels[members, 0] == 0]
    axis = principal_axis(sweeps, newest)
    if axis is None:
        return False
    is_long = np.var(sweeps.pixels[newest, 1:] @ axis) >= (2.0 / sweeps.size) ** 2
    is_rail = is_long and COUNT[sweeps.slices[newest]].sum() < 2 * len(newest)
    along = abs(axis[0] * motion[1] - axis[1] * motion[0]) <= 0.2 * math.hypot(*motion)
    is_static = is_covered(sweeps, newest) and not (sweeps.has_history and both_ends_move(sweeps, members))
    return bool(along and (is_rail or is_static))


def principal_axis(sweeps: SlicedSweeps, members: np.ndarray) -> np.ndarray | None:
    """Direction (y, x) of the line along which pixels lie: their standard deviation is at most 0.3 m across and at
    least 1 m along; None = they do not lie along one."""
    if len(members) == 0:
        return None
    (small, large), axes = np.linalg.eigh(np.cov(sweeps.pixels[members, 1:].T, bias=True))
    return axes[:, 1] if small <= (0.3 / sweeps.size) ** 2 and large >= (1.0 / sweeps.size) ** 2 else None


def is_covered(sweeps: SlicedSweeps, newest: np.ndarray) -> bool:
    """Whether the other sweeps have at least `COVERED` per cent of the slices of some pixels of t+1 in the 3 x 3 pixels
    where they are."""
    _, (near, total) = found_in_place(sweeps, newest, sweeps.around)
    return bool(total > 0 and near * 100 >= total * COVERED)


def both_ends_move(sweeps: SlicedSweeps, members: np.ndarray) -> bool:
    """Whether both ends of a component have moved in one direction along it since the sweep that is farthest from t+1.

    Convention: at least 1.2 m, alike to a tenth of their sum; and the pixels at t+1 have two height slices on average
        and are at most 60 m long. It lies along y, x or a diagonal, the one in which it reaches farthest at t+1. Ties:
        the first direction; of sweeps equally far the first.
    """
    step = sweeps.pixels[members, 0]
    newest, oldest = (members[step == m] for m in (0, np.abs(sweeps.elapsed).argmax()))
    if len(oldest) == 0:
        return False
    half = math.sqrt(0.5)
    axes = sweeps.size * np.array([[1, 0], [0, 1], [half, half], [half, -half]])
    now, then = (axes @ sweeps.pixels[cells, 1:].T for cells in (newest, oldest))
    best = np.ptp(now, axis=1).argmax()
    low, high = now[best].min() - then[best].min(), now[best].max() - then[best].max()
    is_tall = COUNT[sweeps.slices[newest]].sum() >= 2 * len(newest)
    is_short, both = np.ptp(now[best]) <= 60.0, abs(low + high)
    return bool(is_tall and is_short and both >= 2 * LEAST_TRAVEL and abs(low - high) <= 0.1 * both)
