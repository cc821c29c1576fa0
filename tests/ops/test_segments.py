"""Reductions over segments, medians, indices and runs, against NumPy and by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cflow_torch.ops.indices import divide, flat_nonzero, occupied, split_index
from cflow_torch.ops.parabola import vertex
from cflow_torch.ops.segments import (
    bounding_boxes,
    first_of_segment,
    masked_median,
    segment_amin,
    segment_ends,
    segment_median,
)
from cflow_torch.ops.spans import spans


def test_segment_reductions():
    index, values = torch.tensor([2, 0, 2, 4, 0]), torch.tensor([5, 3, -7, 1, 9])
    assert segment_amin(values, index, 6, 99).tolist() == [3, 99, -7, 99, 1, 99]
    assert first_of_segment(torch.tensor([3, 1, 3, 1, 0]), 4).tolist() == [0, 1, 0, 1, 4]
    first, last = segment_ends(values, index, 5)
    assert first[[0, 2, 4]].tolist() == [3, -7, 1] and last[[0, 2, 4]].tolist() == [9, 5, 1]
    assert (last < first)[[1, 3]].all()


def test_bounding_boxes():
    rng = np.random.default_rng(5)
    index = rng.permutation(np.concatenate([np.arange(12), rng.integers(0, 12, 80)]))
    rows, cols = rng.integers(-50, 50, (2, index.size))
    first, size = bounding_boxes(*map(torch.from_numpy, (rows, cols, index)), 12)
    for segment in range(12):
        r, c = rows[index == segment], cols[index == segment]
        assert first[segment].tolist() == [r.min(), c.min()]
        assert size[segment].tolist() == [np.ptp(r) + 1, np.ptp(c) + 1]


def test_medians_are_numpys():
    rng = np.random.default_rng(6)
    for width in (1, 2, 3, 6):
        values, mask = rng.normal(size=(40, width)).round(1), rng.random((40, width)) < 0.6
        found = masked_median(torch.from_numpy(values), torch.from_numpy(mask)).tolist()
        assert found == [float(np.median(v[m])) if m.any() else 0.0 for v, m in zip(values, mask)]
    for num_segments in (1, 5, 40):
        values, index = rng.integers(-4, 5, 60).astype(np.float64), rng.integers(0, num_segments, 60)
        median = segment_median(torch.from_numpy(values), torch.from_numpy(index), num_segments)
        members = [values[index == segment] for segment in range(num_segments)]
        assert median.tolist() == [float(np.median(m)) if len(m) else 0.0 for m in members]
    nothing = torch.zeros(0, dtype=torch.float64)
    assert segment_median(nothing, nothing.long(), 3).tolist() == [0, 0, 0]


def test_indices_of_set_elements():
    for size in (1, 7, 8, 9, 1000):
        image = torch.from_numpy((np.random.default_rng(size).random(size) < 0.1).astype(np.uint8) * 4)
        expected = image.nonzero()[:, 0].tolist()
        assert occupied(image).tolist() == flat_nonzero(image.bool()).tolist() == expected


def test_division_of_indices():
    index = torch.tensor([0, 1, 6, 7, 8, 2**40, 2**62 + 5])
    for width in (1, 2, 7, 701, 2**31 + 1):
        row, col = split_index(index, width)
        assert [tuple(pair) for pair in zip(row.tolist(), col.tolist())] == [divmod(i, width) for i in index.tolist()]
    assert divide(torch.tensor(7), 2) == 3 and divide(torch.tensor(7), 2).shape == ()


def test_spans_are_runs_one_after_the_other():
    start, count = torch.tensor([5, 0, 9, 3]), torch.tensor([2, 0, 3, 1])
    assert spans(start, count).tolist() == spans(start, count, 6).tolist() == [5, 6, 9, 10, 11, 3]


@pytest.mark.parametrize(
    "counts, offset",
    [
        ((3, 9, 3), 0.0),
        ((2, 9, 6), 4 / 20),  # (high - low) / (2 (2 top - low - high))
        ((9, 9, 0), -0.5),
        ((12, 9, 5), -0.5),  # no farther than half a step
        ((9, 9, 9), 0.0),
        ((12, 9, 12), 0.0),  # curves upwards
    ],
)
def test_the_top_of_a_parabola(counts, offset):
    assert vertex(*torch.tensor(counts)).item() == offset
