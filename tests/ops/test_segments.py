"""Medians of segments, against NumPy."""

from __future__ import annotations

import numpy as np
import torch

from cflow_torch.ops.segments import masked_median, segment_median


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
