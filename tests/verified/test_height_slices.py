"""Height-sliced sweeps: the oracle's images, coarse ones as well, slices by hand."""

from __future__ import annotations

import math
from typing import List

import numpy as np
import pytest
import torch
from moving_scenes import from_images
from oracle import compensate, in_range
from oracle.height_slices import coarsen, slice_image, slice_of
from scenes import config, same_bits, scene, sweeps_of

from cflow_torch import Window
from cflow_torch.verified import height_slices as fast
from cflow_torch.verified.height_slices import HeightSlicedSweeps, count_slices

PLAIN = config("verified", min_height=None, num_history=3)


def images_of(sweeps: HeightSlicedSweeps) -> np.ndarray:
    """(B, S, H, W)"""
    shape = (sweeps.num_windows, sweeps.num_steps, sweeps.grid.height, sweeps.grid.width)
    return sweeps.image[:-1].view(shape).numpy()


def expected_images(window: Window) -> List[np.ndarray]:
    clouds, cloud1 = compensate(window, PLAIN)
    inside = [c.points[c.takes_part & in_range(c.points, PLAIN)] for c in (cloud1, *clouds)]
    return [slice_image(points, PLAIN) for points in inside]


def test_images_equal_the_oracle_in_a_batch():
    windows = [scene(seed, num_history=seed % 4) for seed in range(6)]
    found = images_of(sweeps_of(windows, PLAIN))
    assert found.shape[1] == 5
    for images, window in zip(found, windows):
        expected = expected_images(window)
        assert np.array_equal(images[: len(expected)], expected) and not images[len(expected) :].any()
    assert set(found.ravel().tolist()) == set(range(16))


@pytest.mark.parametrize("block", [1, 2, 3])
def test_coarse_pixels_have_the_slices_of_all_their_pixels(block):
    rng = np.random.default_rng(block)
    images = (rng.integers(0, 16, (2, 3, 11, 14)) * (rng.random((2, 3, 11, 14)) < 0.2)).astype(np.uint8)
    sweeps = from_images(images)
    coarse, column = sweeps.coarsen(block)
    for window in range(2):
        assert np.array_equal(coarse[window], [coarsen(image, block) for image in images[window]])
    height, width = coarse.shape[2:]
    assert same_bits(column, (sweeps.window * height + sweeps.row // block) * width + sweeps.col // block)
    assert same_bits(sweeps.slices_at(sweeps.window, sweeps.step, sweeps.row, sweeps.col), sweeps.slices)


def test_slices_by_hand():
    z = torch.tensor([0.0, 0.49, 0.5, 1.0, 1.99, 2.0, -0.01, -0.5, -0.51, -2.0, 1e300, -1e300], dtype=torch.float64)
    assert fast.slice_of(z, 0.5).tolist() == [0, 0, 1, 2, 3, 0, 3, 3, 2, 0, 0, 0]
    assert fast.slice_of(z[:10], 0.1, 16).tolist() == [slice_of(v, 0.1, 16) for v in z[:10].tolist()]
    infinite = torch.tensor([math.inf, -math.inf, math.nan], dtype=torch.float64)
    assert fast.slice_of(infinite, 0.5).tolist() == [0, 0, 0]
    every = torch.arange(16, dtype=torch.uint8)
    assert count_slices(every).tolist() == [bin(value).count("1") for value in range(16)]
