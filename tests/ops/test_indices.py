"""Counts and division of index tensors, against NumPy; lazy tensors. The methods' tests cover lookups."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cflow_torch.ops.indices import floor_divide, lazy_empty, lazy_zeros, scatter_count, split_index

CPU = torch.device("cpu")


def test_indices_are_divided_like_integers():
    index = torch.tensor([0, 1, 6, 7, 8, 2**40, 2**62 + 5])
    for width in (1, 2, 7, 701, 2**31 + 1):
        row, col = split_index(index, width)
        assert [tuple(pair) for pair in zip(row.tolist(), col.tolist())] == [divmod(i, width) for i in index.tolist()]
    assert floor_divide(torch.tensor(7), 2) == 3 and floor_divide(torch.tensor(7), 2).shape == ()


def test_counts_are_those_of_bincount():
    rng = np.random.default_rng(0)
    for number, size in [(0, 0), (0, 4), (1, 1), (50, 7), (1000, 300)]:
        index = rng.integers(0, max(size, 1), number)
        weights = rng.integers(-(2**40), 2**40, (3, number))
        given = torch.from_numpy(index)
        assert scatter_count(given, size).tolist() == np.bincount(index, minlength=size).tolist()
        expected = [[int(row[index == i].sum()) for i in range(size)] for row in weights]
        assert scatter_count(given, size, torch.from_numpy(weights)).tolist() == expected
        assert scatter_count(given, size, torch.from_numpy(weights[1])).tolist() == expected[1]
        halves = scatter_count(given, size, torch.from_numpy(weights / 2))
        assert halves.shape == (3, size) and halves.dtype == torch.float64
        assert halves.tolist() == [[total / 2 for total in row] for row in expected]


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.int64, torch.float32])
def test_lazy_tensors_have_their_size_and_type_and_can_be_written(dtype):
    for size in (0, 5, 10**6):
        zeros, empty = lazy_zeros(size, dtype, CPU), lazy_empty(size, dtype, CPU)
        assert {values.dtype for values in (zeros, empty)} == {dtype}
        assert zeros.shape == empty.shape == (size,) and not zeros.any()
        for values in (zeros, empty):
            assert values.fill_(1).bool().all()
