"""Proof of a motion: what is found again under it and not without it, against the reverse."""

from __future__ import annotations

import math
from typing import Sequence, Tuple

import numpy as np


def paired_counts(
    images: Sequence[np.ndarray], members: Sequence[np.ndarray], motion: Tuple[float, float], elapsed: Sequence[float]
) -> Tuple[int, int]:
    """McNemar counts of a component's motion against no motion, over all sweeps and in both directions.

    Args:
        images: slices (H, W) uint8 of sweep t+1, then of t, t-1, ... (`slice_image`).
        members: (H, W) bool of each sweep, the pixels of the component.
        motion: (y, x), pixels per sweep interval.
        elapsed: sweep intervals from each sweep to t+1; 0 for t+1.

    Returns:
        won: slices of the component that another sweep has where the motion takes them, and not where they are.
        lost: slices that it has where they are, and not where the motion takes them.

    Convention: every sweep before t+1 is compared with t+1, and t+1 with every sweep before, all of whose pixels count,
        not the component's alone. A pixel is taken by floor(k f + 0.5) pixels, k the elapsed time, negative from t+1
        into the past. Outside the image there is nothing.
    """
    won = lost = 0
    for m in range(1, len(images)):
        for source, target, k in ((m, 0, elapsed[m]), (0, m, -elapsed[m])):
            dy, dx = (math.floor(f * k + 0.5) for f in motion)
            for r, c in np.argwhere(members[source]).tolist():
                own = int(images[source][r, c])
                here = own & int(images[target][r, c])
                there = own & _slices(images[target], r + dy, c + dx)
                won += bin(there & ~here).count("1")
                lost += bin(here & ~there).count("1")
    return won, lost


def worth(won: int, lost: int, z: float) -> int:
    """By how much a motion is proved, in sixteenths of a slice: (won - lost) - z sqrt(won + lost), 0 if it is not.

    The difference of two counts of independent events has the variance won + lost if both are equally likely.
    """
    return max(math.floor(16 * ((won - lost) - z * math.sqrt(won + lost))), 0)


def choose(worths: Sequence[int], candidates: Sequence[Tuple[float, float]]) -> Tuple[Tuple[float, float], int]:
    """The candidate worth most, and what it is worth; of equals the first; no motion if none is worth anything."""
    best = worths.index(max(worths))
    return (candidates[best], worths[best]) if worths[best] > 0 else ((0.0, 0.0), 0)


def _slices(image: np.ndarray, row: int, col: int) -> int:
    height, width = image.shape
    return int(image[row, col]) if 0 <= row < height and 0 <= col < width else 0
