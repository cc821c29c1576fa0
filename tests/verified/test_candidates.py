"""Motion candidates: the oracle's peaks and list of motions; sweeps that a window lacks change no choice."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle
from oracle import candidates as oracle
from oracle.component_tree import find_components as oracle_components
from scenes import config, scene, sweeps_of

from cflow_torch.verified.candidates import _find_peaks, list_motions
from cflow_torch.verified.component_tree import find_components


@pytest.mark.parametrize("block", [1, 2])
def test_peaks_equal_the_oracle(block):
    settings, moved = config("verified", num_history=2, max_speed=8.0, pixel_size=0.12), 0
    windows = [scene(seed, num_history=seed % 3) for seed in range(4)]
    sweeps = sweeps_of(windows, settings)
    level = find_components(sweeps, block, False, settings)
    wanted = torch.arange(level.num_components) % 5 > 0
    estimates, scores, available = _find_peaks(level, wanted, sweeps, settings)
    assert not available[~wanted].any() and not estimates[~available].any()
    start = 0
    for window in range(4):
        of_window = for_oracle(sweeps, window)
        expected = oracle_components(of_window, block, False, settings)
        for i, members in enumerate(expected.members, start):
            for m in range(1, len(of_window.images) if wanted[i] else 1):
                peak = oracle.find_peak(of_window, expected, members, m, settings)
                assert available[i, m - 1] == (peak is not None)
                if peak is not None:
                    assert estimates[i, m - 1].tolist() == pytest.approx(peak[0], abs=1e-9)
                    assert float(scores[i, m - 1]) == pytest.approx(peak[1], abs=1e-6)
                    moved += int(any(peak[0]))
        start += len(expected.members)
    assert moved > 10


def random_estimates(seed: int, num_sweeps: int):
    """Whole and parabola's pixels by whole and uneven steps: zeros, ties and opposites abound."""
    rng, count = np.random.default_rng(seed), 300
    whole = rng.integers(-3, 4, (count, num_sweeps, 2)) * (rng.random((count, num_sweeps, 1)) < 0.8)
    free = whole + rng.uniform(-0.5, 0.5, whole.shape)
    given = np.where(rng.random((count, 1, 1)) < 0.6, whole, free).astype(np.float64)
    available = rng.random((count, num_sweeps)) < 0.7
    intervals = np.where(rng.random((count, 1)) < 0.7, 1.0, 1.0625) * np.arange(1, num_sweeps + 1)
    given[~available], intervals[~available] = np.nan, 0.0  # must not be looked at
    return tuple(map(torch.from_numpy, (given, available, intervals, rng.normal(0, 2, (count, 2)))))


@pytest.mark.parametrize("num_sweeps", [1, 2, 3, 5])
def test_motions_equal_the_oracle(num_sweeps):
    given, available, intervals, other = random_estimates(num_sweeps, num_sweeps)
    found = list_motions(given, available, intervals, [other])
    assert found.shape == (300, num_sweeps + 1 + (num_sweeps > 1), 2)
    assert not (torch.signbit(found) & (found == 0)).any()
    for mine, f, known, k, parent in zip(*(v.tolist() for v in (found, given, available, intervals, other))):
        estimates = [tuple(v) if is_known else None for v, is_known in zip(f, known)]
        np.testing.assert_allclose(mine, oracle.list_motions(estimates, k, [tuple(parent)]), atol=1e-9)
