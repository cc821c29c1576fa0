"""Which points of a track are static, by plain loops over cells and sweeps."""

from __future__ import annotations

import numpy as np

CELL = (0.3, 0.3, 0.9)  # metres
APART, NEAR, SHARE = 0.5, 5, 0.3


def static_points(positions: list[np.ndarray], statics: list[set[tuple[int, ...]]]) -> list[list[bool]]:
    """For each sweep the positions (P, 3) of a track, and the cells of the points without a track.

    A cell counts as near in the sweeps whose points, by the box around them, have its first point within `APART`.
    """
    cells = [[tuple(np.floor(point / CELL).astype(int).tolist()) for point in sweep] for sweep in positions]
    places: dict[tuple[int, ...], np.ndarray] = {}
    for sweep, names in zip(positions, cells):
        for point, name in zip(sweep, names):
            places.setdefault(name, point)
    boxes = [(sweep[:, :2].min(0) - APART, sweep[:, :2].max(0) + APART) for sweep in positions]
    is_static = {}
    for name, place in places.items():
        near = [k for k, (low, high) in enumerate(boxes) if (place[:2] >= low).all() and (place[:2] <= high).all()]
        before = [k for k in range(len(positions)) if near[0] - NEAR <= k < near[0]]
        after = [k for k in range(len(positions)) if near[-1] < k <= near[-1] + NEAR]
        is_often = [sum(name in statics[k] for k in part) >= SHARE * len(part) for part in (before, after)]
        is_static[name] = all(is_often) and len(before) + len(after) > 0
    return [[is_static[name] for name in sweep] for sweep in cells]
