"""Rows of a cloud that mean "no return": organised clouds have a row for every shot, and fill some with a default."""

from __future__ import annotations

import numpy as np

_SAMPLE, _FEWEST = 1024, 10  # rows in which we look for a repeated position, and its repetitions, 1 % of them
_STEP = 7919  # between rows of the sample: a prime, so that no pattern of rows repeats with it


def missing_returns(points: np.ndarray) -> np.ndarray:
    """Test which rows of a cloud are no returns, (N,) bool.

    They are not finite, or lie exactly at the origin (the sensor), or at one position that more than 1 % of the rows
    share to the last bit: drivers fill missing returns with a default, which may have been transformed since.

    Args:
        points: (N, 3) floats as stored, in any frame.
    """
    is_missing: np.ndarray = ~np.isfinite(points).all(axis=1) | ~(points != 0).any(axis=1)
    rows = np.flatnonzero(~is_missing)
    sample = points[rows[np.arange(min(_SAMPLE, len(rows))) * _STEP % max(len(rows), 1)]]
    positions, counts = np.unique(sample, axis=0, return_counts=True)
    for position in positions[counts > _FEWEST]:
        same = (points == position).all(axis=1)
        if same.sum() > len(points) * _FEWEST / _SAMPLE:
            is_missing |= same
    return is_missing
