"""Rows of a cloud that mean "no return": organised clouds have a row for every shot, and fill some with a default."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from cflow_torch.types import Array, Sweep, as_numpy

_SAMPLE, _FEWEST = 1024, 10  # rows in which we look for a repeated position, and its repetitions, 1 % of them
_GOLDEN = (5**0.5 - 1) / 2  # rows at multiples of this share of all rows are spread evenly, whatever their number
_TOO_MANY = 10_000_000  # points of a sweep
MISSING = "points of a sweep are no returns (exactly at 0, or many at one position)"


def missing_returns(points: np.ndarray) -> np.ndarray:
    """Test which rows of a cloud are no returns, (N,) bool.

    They are not finite, or lie exactly at the origin (the sensor), or at one position that more than 1 % of the rows
    share to the last bit: drivers fill missing returns with a default, which may have been transformed since.

    Args:
        points: (N, 3) floats as stored, in any frame.
    """
    is_missing: np.ndarray = ~np.isfinite(points).all(axis=1) | ~(points != 0).any(axis=1)
    rows = np.flatnonzero(~is_missing)
    sample = points[rows[_sample_of(len(rows))]]
    positions, counts = np.unique(sample, axis=0, return_counts=True)
    for position in positions[counts > _FEWEST]:
        same = (points == position).all(axis=1)
        if same.sum() > len(points) * _FEWEST / _SAMPLE:
            is_missing |= same
    return is_missing


def without_missing(sweep: Sweep) -> tuple[Sweep, int]:
    """Return a sweep whose missing returns are NaN, and how many these are.

    Sweeps with at most 1 % of them, or ten, stay as they are. So do points on a GPU, and more than ten million points.
    """
    points: Array = sweep.points
    is_elsewhere = isinstance(points, torch.Tensor) and points.device.type != "cpu"
    if is_elsewhere or len(points) > _TOO_MANY:
        return sweep, 0
    values = as_numpy(points)[:, :3]
    sample = values[_sample_of(len(values))]
    if missing_returns(sample[np.isfinite(sample).all(axis=1)]).sum() <= _FEWEST:
        return sweep, 0
    is_missing = missing_returns(values) & np.isfinite(values).all(axis=1)
    rows: Any = np.flatnonzero(is_missing)
    if isinstance(points, torch.Tensor):
        points, rows = points.detach().clone(), torch.from_numpy(rows)
    else:
        points = points.copy()
    points[rows, :3] = np.nan
    return replace(sweep, points=points), int(is_missing.sum())


def _sample_of(count: int) -> np.ndarray:
    """Return up to 1024 rows of so many, (K,) int64."""
    if count <= _SAMPLE:
        return np.arange(count)
    return (np.arange(_SAMPLE) * _GOLDEN % 1 * count).astype(np.int64)
