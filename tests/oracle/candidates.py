"""Candidates for the motion of a component: of each sweep, of all sweeps together, of others."""

from __future__ import annotations

from typing import List, Optional, Sequence, Tuple

import numpy as np

from oracle.pooling import pool

Vector = Tuple[float, float]


def candidates(
    estimates: Sequence[Optional[Vector]], intervals: Sequence[float], others: Sequence[Vector] = ()
) -> List[Vector]:
    """Motions per sweep interval that one component may have, in the order in which ties are decided.

    Args:
        estimates: (y, x) displacement m -> t+1 for every sweep m = t, t-1, ..., nearest first; None = not known.
        intervals: k, sweep intervals from m to t+1.
        others: motions from elsewhere: what the coarser level gave to the component, what key points say.

    Returns:
        The pool of all estimates (Sec. leverage_past_pcs), if there is more than one sweep; each sweep's estimate by
        its k; the others. (0, 0), which never wins, stands for what is not known.
    """
    per_interval = [None if f is None else (f[0] / k, f[1] / k) for f, k in zip(estimates, intervals)]
    found = [(0.0, 0.0) if f is None else f for f in per_interval]
    if len(estimates) > 1:
        known = [np.array([*f, 0.0]) for f in per_interval if f is not None]
        y, x, _ = pool(known).tolist() if known else (0.0, 0.0, 0.0)
        found.insert(0, (y, x))
    return [*found, *others]


def inherit(members: Sequence[np.ndarray], above: Sequence[np.ndarray], motions: Sequence[Vector]) -> Vector:
    """Motion of the coarser component that a component lies in.

    Args:
        members: (H, W) bool of sweep t+1, then of t, t-1, ..., the pixels of the component.
        above: (H, W) int of each sweep, coarser component of each pixel, -1 = none.
        motions: motion of each coarser component.

    Returns:
        That of the first member with a coarser component, in the order of the sweeps, then of the raster; (0, 0) if
        none has one. Components are nested but for erosion, so that other members seldom have another one.
    """
    for member, coarser in zip(members, above):
        for r, c in np.argwhere(member).tolist():
            if coarser[r, c] >= 0:
                return motions[int(coarser[r, c])]
    return 0.0, 0.0
