"""Pooling of several estimates (Sec. leverage_past_pcs): the oracle's, trigonometry, known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.history import pool as oracle_pool

from cflow_torch.dense.history import pool


def rows(rng: np.random.Generator, num_rows: int, count: int) -> np.ndarray:
    """Estimates as they occur: whole pixels divided by whole steps, so ties, zeros and opposites abound."""
    pixels = rng.integers(-3, 4, (num_rows, count, 3)) * (rng.random((num_rows, count, 1)) < 0.8)
    free = rng.normal(size=(num_rows, count, 3))
    whole = pixels * 0.1 / np.arange(1, count + 1)[None, :, None]
    return np.where(rng.random((num_rows, 1, 1)) < 0.7, whole, free)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 9])
def test_pool_equals_the_oracle(count):
    rng = np.random.default_rng(20 + count)
    given, available = rows(rng, 1000, count), rng.random((1000, count)) < 0.75
    available[np.arange(1000), rng.integers(0, count, 1000)] = True
    given[~available] = math.nan  # must not be looked at
    found = pool(torch.from_numpy(given), torch.from_numpy(available)).numpy()
    expected = [oracle_pool(list(estimates[mask])) for estimates, mask in zip(given, available)]
    np.testing.assert_allclose(found, expected, atol=1e-9)


@pytest.mark.parametrize(
    "estimates, expected",
    [
        ([(3, -4, 2)], (3, -4, 2)),
        ([(1, 0, 0), (4, 0, 0), (2, 0, 0)], (2, 0, 0)),
        ([(1, 0, 1), (3, 0, 2)], (2, 0, 1.5)),  # even: the mean of the middle two
        ([(1, 0, 0), (0, 5, 0), (3, 0, 0)], (3, 0, 0)),  # orientation and magnitude from different estimates
        ([(3, 0, 0), (0, 1, 0)], (math.sqrt(2), math.sqrt(2), 0)),  # bisector, length (3 + 1) / 2
        ([(1, 0, 0), (-1, 0, 0)], (1, 0, 0)),  # opposite: the nearest
        ([(-1, 0, 0), (1, 0, 0)], (-1, 0, 0)),
        ([(1, 0, 0), (-1, 0, 0), (0, 1, 0)], (0, 1, 0)),
        ([(0, 2, 0), (0, -2, 0), (0, 2, 0), (0, -2, 0)], (0, 2, 0)),
        ([(-8, 6, 0), (-10, 0, 0), (-8, -6, 0)], (-10, 0, 0)),  # across the cut at 180 degrees
        ([(0, 0, 0), (2, 0, 0)], (1, 0, 0)),  # zero counts as a magnitude, has no orientation
        ([(0, 0, 0), (0, 0, 0), (3, 0, 0)], (0, 0, 0)),
        ([(0, 0, 1), (0, 0, 3), (0, 0, 7)], (0, 0, 3)),
    ],
)
def test_pool_by_hand(estimates, expected):
    given = torch.tensor([estimates], dtype=torch.float64)
    found = pool(given, torch.ones(given.shape[:2], dtype=torch.bool))[0].tolist()
    assert found == pytest.approx(list(expected), abs=1e-15)
    assert oracle_pool([np.array(e, dtype=float) for e in estimates]).tolist() == pytest.approx(found, abs=1e-15)
