"""Nearest set pixels and the lower surface of height maps, against loops."""

from __future__ import annotations

import numpy as np
import torch

from cflow_torch.ops.lower_surface import UNKNOWN, _cone, lower_surface
from cflow_torch.ops.nearest import nearest_set_pixel


def test_the_nearest_pixel_is_the_first_in_raster_order_among_ties():
    for seed in range(9):
        rng = np.random.default_rng(seed)
        seeds = rng.random((3, 11, 8)) < (0.0, 0.02, 0.2)[seed % 3]
        seeds[1] = False
        pixels = np.sort(rng.choice(seeds.size, 60, replace=False))
        expected = []
        for image, row, col in zip(*np.unravel_index(pixels, seeds.shape)):
            found = np.argwhere(seeds[image])  # in raster order, so argmin breaks ties
            best = found[((found - (row, col)) ** 2).sum(1).argmin()] if len(found) else None
            expected.append(-1 if best is None else int(np.ravel_multi_index((image, *best), seeds.shape)))
        assert nearest_set_pixel(torch.from_numpy(seeds), torch.from_numpy(pixels)).tolist() == expected
    assert nearest_set_pixel(torch.ones((1, 2, 2), dtype=torch.bool), torch.zeros(0, dtype=torch.int64)).shape == (0,)


def test_cones_are_the_highest_surfaces_of_limited_slope():
    heights = torch.from_numpy(np.random.default_rng(0).integers(-900, 900, (2, 7, 9)).astype(np.int32))
    found = _cone(heights, 51)
    for b, r, c in np.ndindex(*heights.shape):
        steps = np.abs(np.arange(7) - r)[:, None] + np.abs(np.arange(9) - c)
        assert found[b, r, c] == (heights[b].numpy() + 51 * steps).min()


def test_the_lower_surface_passes_below_objects():
    slope = 40 * np.arange(40)[:, None] + np.zeros((40, 40))
    low = torch.from_numpy(slope.astype(np.int32))[None]
    ground = low.clone()
    low[0, 10:14, 10:14] += 1500  # a box
    low[0, 25:30, 5:20] = UNKNOWN
    found = lower_surface(low)[0]
    assert (found - ground[0]).abs().max() <= 70
