"""Pooling of several estimates (Sec. leverage_past_pcs): the oracle's, trigonometry, known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.history import pool as oracle_pool
from scenes import same_bits

from cflow_torch.dense.history import pool


def by_angles(estimates: np.ndarray) -> np.ndarray:
    """The same with sine, cosine and arc tangent; for estimates of positive length in general position."""
    angle = np.arctan2(estimates[:, 1], estimates[:, 0])
    mean = math.atan2(np.sin(angle).sum(), np.cos(angle).sum())
    offset = np.sort((angle - mean + np.pi) % (2 * np.pi) - np.pi)
    low, high = offset[(len(offset) - 1) // 2], offset[len(offset) // 2]
    middle = mean + math.atan2(math.sin(low) + math.sin(high), math.cos(low) + math.cos(high))
    length = np.median(np.hypot(estimates[:, 0], estimates[:, 1]))
    return np.array([length * math.cos(middle), length * math.sin(middle), np.median(estimates[:, 2])])


@pytest.mark.parametrize("count", [2, 3, 4, 5])
@pytest.mark.parametrize("spread", [0.3, 3.0])
def test_pool_equals_trigonometry(spread, count):
    rng = np.random.default_rng(count)
    angle = rng.uniform(-np.pi, np.pi, (300, 1)) + rng.uniform(-spread, spread, (300, count))
    length = rng.uniform(0.1, 3.0, (300, count))
    given = np.stack([length * np.cos(angle), length * np.sin(angle), rng.normal(size=(300, count))], 2)
    found = pool(torch.from_numpy(given), torch.ones((300, count), dtype=torch.bool)).numpy()
    np.testing.assert_allclose(found, [by_angles(estimates) for estimates in given], atol=1e-9)


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


def test_rows_are_independent_and_may_be_none():
    given = torch.from_numpy(rows(np.random.default_rng(2), 40, 4))
    available = torch.ones(40, 4, dtype=torch.bool)
    alone = [pool(given[i : i + 1], available[i : i + 1]) for i in range(40)]
    assert same_bits(torch.cat(alone), pool(given, available))
    assert pool(given[:0], available[:0]).shape == (0, 3)
