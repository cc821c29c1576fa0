"""Counts by FFT on images so large that rounding could matter; dense/test_correlation.py compares smaller ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from cflow_torch.ops.cross_correlation import cross_correlate


@pytest.mark.parametrize("shape", [(100, 100), (317, 401), (4, 3000)])
def test_fft_counts_stay_exact_on_full_images(shape):
    # The largest counts there are: the overlap of two full images is (H - |dy|) (W - |dx|).
    height, width = shape
    template = F.pad(torch.ones((1, *shape)), (0, width // 2, 0, height // 2))
    target = F.pad(torch.ones((1, *shape)), (width // 2, 0, height // 2, 0))  # moved by half the size
    found = cross_correlate(torch.cat((template, target)), 1, torch.zeros(1, dtype=torch.int64), "fft")
    rows, cols = (side - abs(np.arange(-(side // 2), side // 2 + 1)) for side in shape)
    found = found[0, : len(rows), : len(cols)]
    assert (found - found.round()).abs().max() < 0.5 and np.array_equal(found.round(), rows[:, None] * cols)
