"""Pooling of several estimates (Sec. leverage_past_pcs): known answers, which the oracle gives as well."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.history import pool as oracle_pool

from cflow_torch.dense.history import pool


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
