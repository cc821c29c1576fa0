"""Cross-correlation of full images stays exact; pixels under a window are counted one by one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from cflow_torch.ops.cross_correlation import cross_correlate
from cflow_torch.ops.window_counts import WindowCounts


@pytest.mark.parametrize("shape", [(100, 100), (317, 401), (4, 3000)])
def test_fft_counts_stay_exact_on_full_images(shape):
    # The largest counts there are: the overlap of two full images is (H - |dy|) (W - |dx|).
    full = torch.ones((1, *shape), dtype=torch.bool)
    rows, cols = (side - abs(np.arange(-(side // 2), side // 2 + 1)) for side in shape)
    height, width = shape
    template = F.pad(full.float(), (0, width // 2, 0, height // 2))
    target = F.pad(full.float(), (width // 2, 0, height // 2, 0))  # moved by half the size: no shift is negative
    found = cross_correlate(torch.cat((template, target)), 1, torch.zeros(1, dtype=torch.int64), "fft")
    found = found[0, : len(rows), : len(cols)]
    assert ((found - found.round()).abs() < 0.5).all()
    assert np.array_equal(found.round().long().numpy(), rows[:, None] * cols)


def test_pixels_under_a_window_and_their_bounds():
    rng, sizes = np.random.default_rng(1), [(1, 1), (5, 9), (12, 3), (7, 7)]
    images = [rng.random(size) < 0.4 for size in sizes]
    pixels = np.concatenate([np.column_stack([np.full(i.sum(), n), np.argwhere(i)]) for n, i in enumerate(images)])
    table = WindowCounts(*torch.from_numpy(pixels).t().contiguous(), np.array(sizes))
    image = rng.integers(0, len(sizes), 200)
    dy, dx = (rng.integers(-np.array(sizes)[image, axis], np.array(sizes)[image, axis] + 1) for axis in (0, 1))
    expected = [
        int(np.pad(images[n], [(12, 12), (12, 12)])[12 + y : 12 + y + sizes[n][0], 12 + x : 12 + x + sizes[n][1]].sum())
        for n, y, x in zip(image, dy, dx)
    ]
    given = tuple(map(torch.from_numpy, (image, np.stack((dy, dx)))))
    found, (least, most) = table.count(*given), table.bounds(*given)
    assert found.tolist() == expected and sum(expected) > 100
    assert (least <= found).all() and (found <= most).all()
