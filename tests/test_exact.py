"""Square roots that round the same way everywhere."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cflow_torch.ops.exact import exact_sqrt


@pytest.mark.parametrize("scale", [1e-12, 1.0, 4.0, 1e6, 1e12])
def test_equals_the_correctly_rounded_root(scale: float) -> None:
    x = np.random.default_rng(0).random(200_000) * scale
    assert np.array_equal(exact_sqrt(torch.from_numpy(x)).numpy(), np.sqrt(x))


def test_squares_and_their_neighbours() -> None:
    roots = np.concatenate(
        (np.arange(0.0, 5000.0), 2.0 ** np.arange(-200, 200), np.array([1 - 2.0**-53, 1 + 2.0**-52]))
    )
    for x in (roots * roots, np.nextafter(roots * roots, np.inf), np.nextafter(roots * roots, 0.0)):
        x = x[(x == 0) | (x > 1e-200)]
        assert np.array_equal(exact_sqrt(torch.from_numpy(x)).numpy(), np.sqrt(x))


@given(st.floats(1e-200, 1e200))
def test_any_number(x: float) -> None:
    assert exact_sqrt(torch.tensor([x], dtype=torch.float64)).item() == math.sqrt(x)
