"""Cross-correlation counts, against a loop over pairs of pixels."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from cflow_torch.ops.cross_correlation import cross_correlate

ENGINES = ("fft", "conv")


def counts(template, target, own, engine) -> torch.Tensor:
    """(J, 2 (H // 2) + 1, 2 (W // 2) + 1) int64, shifts in ascending order."""
    height, width = template.shape[1:]
    templates = F.pad(template.float(), (0, width // 2, 0, height // 2))
    targets = F.pad(target.float(), (width // 2, 0, height // 2, 0))  # moved by half the size: no shift is negative
    values = cross_correlate(torch.cat((templates, targets)), len(template), own, engine)
    values = values[:, : 2 * (height // 2) + 1, : 2 * (width // 2) + 1]
    assert ((values - values.round()).abs() < 0.5).all()
    return values.round().long()


def count_directly(template: np.ndarray, target: np.ndarray) -> np.ndarray:
    """sum over p of template(p) target(p + d), for all d within half the size: pairs of pixels, one by one."""
    height, width = template.shape
    result = np.zeros((2 * (height // 2) + 1, 2 * (width // 2) + 1), dtype=np.int64)
    for r, c in np.argwhere(template):
        for i, j in np.argwhere(target):
            dy, dx = i - r + height // 2, j - c + width // 2
            if 0 <= dy < result.shape[0] and 0 <= dx < result.shape[1]:
                result[dy, dx] += 1
    return result


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2, 1), (1, 13), (8, 8), (15, 10), (3, 40)])
def test_counts_are_those_of_pairs_of_pixels(shape, engine):
    rng = np.random.default_rng(sum(shape))
    template, target = rng.random((5, *shape)) < 0.3, rng.random((3, *shape)) < 0.4
    template[0], target[2] = True, True
    own = np.array([2, 0, 2, 1, 0])
    found = counts(*map(torch.from_numpy, (template, target, own)), engine)
    assert found.tolist() == [count_directly(template[j], target[n]).tolist() for j, n in enumerate(own)]


@pytest.mark.parametrize("shape", [(100, 100), (317, 401), (4, 3000)])
def test_fft_counts_stay_exact_on_full_images(shape):
    # The largest counts there are: the overlap of two full images is (H - |dy|) (W - |dx|).
    full = torch.ones((1, *shape), dtype=torch.bool)
    rows, cols = (side - abs(np.arange(-(side // 2), side // 2 + 1)) for side in shape)
    found = counts(full, full, torch.zeros(1, dtype=torch.int64), "fft")
    assert np.array_equal(found[0].numpy(), rows[:, None] * cols)
