"""Colours for clusters: the nearer two clusters are, the surer their colours differ."""

from __future__ import annotations

from typing import Tuple

import numpy as np

PALETTE = (
    "#e6194b", "#3cb44b", "#4363d8", "#f58231", "#911eb4", "#00a0b0", "#b8860b", "#f032e6", "#7a4b1f", "#6b8e23"
)  # fmt: skip
_NUM_HUES, _HUE_STEP = 10, 0.3  # of the hue circle: every tenth of it, those of neighbouring numbers far apart
_NO_CLUSTER = (100, 105, 112)
_CELL = 1.0  # metres; distances between clusters are those of cells that they have points in
_MOST_CELLS = 6000  # wider scenes get larger cells


def color_numbers(position: np.ndarray, group: np.ndarray, num_colors: int = len(PALETTE)) -> np.ndarray:
    """A colour for every group.

    Args:
        position: (N, 2+) float64, metres, finite.
        group: (N,) int64, 0 ... G - 1; negative = in no group.
        num_colors: colours to choose from.

    Returns:
        (G,) int64, 0 ... num_colors - 1; 0 for a group without points.

    Convention: largest group first, each takes the colour whose nearest bearer is farthest away; ties: fewest bearers,
        then the first colour. So no two of any `num_colors` groups that all lie next to each other look alike.

    Cost: square of the number of cells, which is at most 6000, or the number of groups if there are more.
    """
    position, group = position[group >= 0, :2], group[group >= 0]
    num_groups = int(group.max(initial=-1)) + 1
    row, col, owner = _cells(position, group)
    color = np.full(num_groups, -1)
    bearers = np.zeros(num_colors, np.int64)
    for chosen in np.argsort(-np.bincount(group, minlength=num_groups), kind="stable"):
        own = owner == chosen
        if not own.any():
            continue
        near = np.full(num_colors, np.inf)
        others = color[owner] >= 0
        if others.any():
            away = np.maximum(np.abs(row[own][:, None] - row[others]), np.abs(col[own][:, None] - col[others])).min(
                axis=0
            )
            np.minimum.at(near, color[owner[others]], away)
        best = np.lexsort((np.arange(num_colors), bearers, -near))[0]
        color[chosen] = best
        bearers[best] += 1
    return np.maximum(color, 0)


def cluster_to_rgb(position: np.ndarray, cluster_id: np.ndarray) -> np.ndarray:
    """The colour of each point's cluster, on black; clusters near each other differ. Grey where there is none.

    Args:
        position: (N, 3) float64, metres, finite.
        cluster_id: (N,) int64, -1 = none.

    Returns:
        (N, 3) uint8 RGB.
    """
    has_one = cluster_id >= 0
    _, group = np.unique(cluster_id[has_one], return_inverse=True)
    number = np.zeros(len(cluster_id), np.int64)
    number[has_one] = color_numbers(position[has_one], group, _NUM_HUES)[group]
    hue = np.mod(number * _HUE_STEP, 1.0)[:, None]
    # Three waves a third of the circle apart, cut to 0 ... 1: the hue circle.
    wave = np.clip(np.abs(np.mod(hue + np.array([0, 2 / 3, 1 / 3]), 1) * 6 - 3) - 1, 0, 1)
    bright = 90 + 165 * wave
    return np.where(has_one[:, None], bright, _NO_CLUSTER).astype(np.uint8)


def _cells(position: np.ndarray, group: np.ndarray) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row, column and group, (C,) int64 each, of every cell of every group."""
    side = _CELL
    while True:
        pixel = np.floor(position / side).astype(np.int64)
        cells = np.unique(np.column_stack([pixel[:, 1], pixel[:, 0], group]), axis=0)
        if len(cells) <= max(_MOST_CELLS, group.max(initial=0) + 1):
            row, col, owner = cells.T
            return row, col, owner
        side *= 2
