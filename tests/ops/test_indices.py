"""Lookups, counts, renumbering and division of index tensors, against NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cflow_torch.ops.indices import (
    floor_divide,
    gather,
    lazy_empty,
    lazy_zeros,
    lookup,
    occupied,
    renumber,
    scatter_count,
    split_index,
)

CPU = torch.device("cpu")


def test_indices_are_divided_like_integers():
    index = torch.tensor([0, 1, 6, 7, 8, 2**40, 2**62 + 5])
    for width in (1, 2, 7, 701, 2**31 + 1):
        row, col = split_index(index, width)
        assert [tuple(pair) for pair in zip(row.tolist(), col.tolist())] == [divmod(i, width) for i in index.tolist()]
    assert floor_divide(torch.tensor(7), 2) == 3 and floor_divide(torch.tensor(7), 2).shape == ()


def test_gather_takes_the_same_elements_of_several_tensors():
    index, one, two = torch.tensor([2, 0, 2]), torch.tensor([5, 6, 7]), torch.arange(6.0).view(3, 2)
    taken_one, taken_two = gather(index, one, two)
    assert taken_one.tolist() == [7, 5, 7] and taken_two.tolist() == [[4, 5], [0, 1], [4, 5]]
    assert gather(index) == () and [len(values) for values in gather(index[:0], one, two)] == [0, 0]


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64, torch.float64])
def test_lookup_has_a_default_behind_the_end(dtype):
    table = torch.tensor([1, 0, 1], dtype=dtype)
    assert lookup(table, torch.tensor([3, 0, 1, 3])).tolist() == [0, 1, 0, 0]
    found = lookup(table, torch.tensor([3, 0, 1]), 1)
    assert found.tolist() == [1, 1, 0] and found.dtype == dtype
    rows = lookup(table[:, None].expand(3, 2), torch.tensor([2, 3]), 1)
    assert rows.tolist() == [[1, 1], [1, 1]] and lookup(table[:0], torch.tensor([0, 0]), 1).tolist() == [1, 1]


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


def test_renumber_gives_positions_in_the_list():
    index = torch.tensor([4, 1, 7])
    number = renumber(index, 8)
    assert number.tolist() == [3, 1, 3, 3, 0, 3, 3, 2, 3] and number[index].tolist() == [0, 1, 2]
    assert renumber(index[:0], 2).tolist() == [0, 0, 0] and renumber(index[:0], 0).tolist() == [0]


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int32, torch.int64, torch.float32])
def test_lazy_tensors_have_their_size_and_type_and_can_be_written(dtype):
    for size in (0, 5, 10**6):
        zeros, empty = lazy_zeros(size, dtype, CPU), lazy_empty(size, dtype, CPU)
        assert {values.dtype for values in (zeros, empty)} == {dtype}
        assert zeros.shape == empty.shape == (size,) and not zeros.any()
        for values in (zeros, empty):
            assert values.fill_(1).bool().all()


def test_occupied_is_nonzero():
    rng = np.random.default_rng(1)
    for size in (1, 7, 8, 9, 1003):
        image = torch.from_numpy((rng.random(size) < 0.1) * rng.integers(1, 256, size)).to(torch.uint8)
        assert occupied(image).tolist() == image.nonzero()[:, 0].tolist()
