"""Square roots that round the same way everywhere."""

from __future__ import annotations

import math
from typing import Callable

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from cflow_torch.ops.exact import corrected_sqrt, exact_sqrt

roots = pytest.mark.parametrize("root", [exact_sqrt, corrected_sqrt])


@roots
@pytest.mark.parametrize("scale", [1e-12, 1.0, 4.0, 1e6, 1e12])
def test_equals_the_correctly_rounded_root(scale: float, root: Callable[[Tensor], Tensor]) -> None:
    x = np.random.default_rng(0).random(200_000) * scale
    assert np.array_equal(root(torch.from_numpy(x)).numpy(), np.sqrt(x))


@roots
def test_squares_and_their_neighbours(root: Callable[[Tensor], Tensor]) -> None:
    numbers = np.concatenate(
        (np.arange(0.0, 5000.0), 2.0 ** np.arange(-200, 200), np.array([1 - 2.0**-53, 1 + 2.0**-52]))
    )
    for x in (numbers * numbers, np.nextafter(numbers * numbers, np.inf), np.nextafter(numbers * numbers, 0.0)):
        x = x[(x == 0) | (x > 1e-200)]
        assert np.array_equal(root(torch.from_numpy(x)).numpy(), np.sqrt(x))


@given(st.floats(1e-200, 1e200))
def test_any_number(x: float) -> None:
    for root in (exact_sqrt, corrected_sqrt):
        assert root(torch.tensor([x], dtype=torch.float64)).item() == math.sqrt(x)
