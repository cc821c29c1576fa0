"""Pooling of several estimates (Sec. leverage_past_pcs): the reference's bits, and trigonometry to 1e-9."""

from __future__ import annotations

import math

import numpy as np
import oracle as ref
import pytest
import torch
from scenes import needs_gpu, same_bits

from cflow_torch.dense.history import pool


def pooled(*estimates) -> list:
    """Pool of plain estimates, nearest first."""
    given = torch.tensor([estimates], dtype=torch.float64)
    return pool(given, torch.ones(given.shape[:2], dtype=torch.bool))[0].tolist()


def by_angles(estimates: np.ndarray) -> np.ndarray:
    """The same with sine, cosine and arc tangent; for estimates of positive length in general position."""
    angle = np.arctan2(estimates[:, 1], estimates[:, 0])
    mean = math.atan2(np.sin(angle).sum(), np.cos(angle).sum())
    offset = np.sort((angle - mean + np.pi) % (2 * np.pi) - np.pi)
    low, high = offset[(len(offset) - 1) // 2], offset[len(offset) // 2]
    middle = mean + math.atan2(math.sin(low) + math.sin(high), math.cos(low) + math.cos(high))
    length = np.median(np.hypot(estimates[:, 0], estimates[:, 1]))
    return np.array([length * math.cos(middle), length * math.sin(middle), np.median(estimates[:, 2])])


@pytest.mark.parametrize("count", [2, 3, 4, 5, 6, 7])
@pytest.mark.parametrize("spread", [0.3, 3.0])
def test_pool_equals_trigonometry(spread, count):
    rng = np.random.default_rng(count)
    angle = rng.uniform(-np.pi, np.pi, (300, 1)) + rng.uniform(-spread, spread, (300, count))
    length = rng.uniform(0.1, 3.0, (300, count))
    given = np.stack([length * np.cos(angle), length * np.sin(angle), rng.normal(size=(300, count))], 2)
    found = pool(torch.from_numpy(given), torch.ones((300, count), dtype=torch.bool)).numpy()
    for row, estimates in zip(found, given):
        assert np.abs(row - by_angles(estimates)).max() < 1e-9


def rows(rng: np.random.Generator, num_rows: int, count: int) -> np.ndarray:
    """Estimates as they occur: whole pixels divided by whole steps, so ties, zeros and opposites abound."""
    pixels = rng.integers(-3, 4, (num_rows, count, 3)) * (rng.random((num_rows, count, 1)) < 0.8)
    free = rng.normal(size=(num_rows, count, 3))
    whole = pixels * 0.1 / np.arange(1, count + 1)[None, :, None]
    return np.where(rng.random((num_rows, 1, 1)) < 0.7, whole, free)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 9])
def test_pool_equals_the_reference_to_the_bit(count):
    rng = np.random.default_rng(20 + count)
    given = rows(rng, 1500, count)
    given[:3] *= [[[1e-200]], [[1e150]], [[5e-324]]]
    available = rng.random((1500, count)) < 0.75
    available[np.arange(1500), rng.integers(0, count, 1500)] = True
    given[~available] = math.nan  # must not be looked at
    found = pool(torch.from_numpy(given), torch.from_numpy(available)).numpy()
    for row, estimates, mask in zip(found, given, available):
        expected = ref.pool(list(estimates[mask]))
        assert row.tobytes() == expected.tobytes(), f"{row} is not {expected} for {estimates[mask]}"


def test_unavailable_estimates_are_not_looked_at():
    given = torch.full((2, 4, 3), math.nan, dtype=torch.float64)
    given[0, 2] = torch.tensor([1.0, 2.0, 3.0])
    given[1, 1:3] = torch.tensor([[1.0, 0.0, 2.0], [3.0, 0.0, 4.0]])
    available = torch.tensor([[False, False, True, False], [False, True, True, False]])
    assert pool(given, available).tolist() == [[1.0, 2.0, 3.0], [2.0, 0.0, 3.0]]


@pytest.mark.parametrize(
    "estimates, expected",
    [
        ([(3, 4, 1)], (3, 4, 1)),
        ([(1, 0, 0), (3, 0, 2)], (2, 0, 1)),  # even: the mean of the middle two
        ([(1, 0, 0), (0, 2, 0), (0, 3, 0)], (0, 2, 0)),  # magnitude and orientation of different sweeps
        ([(0, 0, 0), (0, 0, 5)], (0, 0, 2.5)),  # no orientation at all
        ([(0, 0, 0), (2, 0, 0)], (1, 0, 0)),  # a zero counts among the magnitudes only
        ([(0, 0, 0), (0, 0, 0), (2, 0, 0)], (0, 0, 0)),
        ([(1, 0, 0), (-1, 0, 0)], (1, 0, 0)),  # opposite: ordered about the nearest, the bisector is undefined
        ([(-1, 0, 0), (1, 0, 0)], (-1, 0, 0)),
        ([(-1, 0.0, 0), (-1, 0.0, 0), (0, 1, 0)], (-1, 0, 0)),  # across the seam of atan2
    ],
)
def test_pool_by_hand(estimates, expected):
    assert pooled(*estimates) == pytest.approx(list(expected), abs=1e-15)


def test_pool_of_no_clusters():
    assert pool(torch.zeros(0, 3, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.bool)).shape == (0, 3)
    assert pool(torch.zeros(0, 1, 3, dtype=torch.float64), torch.zeros(0, 1, dtype=torch.bool)).shape == (0, 3)


def test_rows_are_independent():
    rng = np.random.default_rng(2)
    given, available = torch.from_numpy(rows(rng, 40, 4)), torch.ones(40, 4, dtype=torch.bool)
    together = pool(given, available)
    for i in range(40):
        assert same_bits(pool(given[i : i + 1], available[i : i + 1])[0], together[i])


@pytest.mark.cuda
@needs_gpu
def test_pool_on_cuda_equals_cpu():
    rng = np.random.default_rng(3)
    given, available = torch.from_numpy(rows(rng, 2000, 5)), torch.from_numpy(rng.random((2000, 5)) < 0.7)
    available[:, 2] = True
    assert same_bits(pool(given.cuda(), available.cuda()), pool(given, available))
