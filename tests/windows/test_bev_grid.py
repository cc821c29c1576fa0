"""The BEV grid: pixels of the oracle where rounding decides, ends of the region, occupancy, size limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.pixels import bev_dims, project_bev
from scenes import config

from cflow_torch import CFlowError
from cflow_torch.windows.bev_grid import Grid

INF = math.inf


@pytest.mark.parametrize("size", [0.1, 0.125, 0.3, 1 / 3, 0.07])
def test_pixels_equal_the_oracle(size):
    lower, upper = (-35.0, -20.1, -INF), (35.0, 20.0, INF)
    grid, settings = Grid(size, lower, upper), config(pixel_size=size, point_cloud_range=(*lower, *upper))
    assert (grid.height, grid.width) == bev_dims(settings, size)
    rng = np.random.default_rng(1)
    edges = lower[0] + size * np.arange(grid.width)  # where rounding decides
    x = np.concatenate([rng.uniform(-35, 35, 5000), edges, np.nextafter(edges, 99), [-35.0, 35.0]]).clip(-35, 35)
    y = np.concatenate([rng.uniform(-20.1, 20, x.size - 2), [-20.1, 20.0]])
    points = np.stack([x, y, np.zeros_like(x)], 1)
    row, col = project_bev(points, settings, size).T
    assert (grid.pixel(torch.from_numpy(points.T.copy())).numpy() == row * grid.width + col).all()
    assert col.max() == grid.width - 1  # the upper end belongs to the last pixel


def test_the_region_includes_both_ends_and_no_nan():
    grid = Grid(0.5, (-1.0, -2.0, -3.0), (1.0, 2.0, 3.0))
    inside = [(-1, -2, -3), (1, 2, 3), (0, 0, 0)]
    beyond = [(np.nextafter(1, 2), 0, 0), (0, np.nextafter(-2, -3), 0), (0, 0, np.nextafter(3, 4)), (0, 0, -3.1)]
    broken = [(np.nan, 0, 0), (0, np.nan, 0), (0, 0, np.nan), (np.inf, 0, 0), (0, -np.inf, 0), (0, 0, np.inf)]
    points = torch.tensor(inside + beyond + broken, dtype=torch.float64).t()
    assert grid.contains(points).tolist() == [True] * 3 + [False] * 10


def test_pixel_numbers_of_many_images_do_not_overflow():
    grid, num_images = Grid(0.5, (0.0, 0.0, -1.0), (1000.0, 1000.0, 1.0)), 2**11
    positions = torch.tensor([[0.25, 999.9], [0.25, 999.9]], dtype=torch.float64)
    image, area = torch.tensor([0, num_images - 1], dtype=torch.int32), grid.height * grid.width
    assert num_images * area > 2**32
    pixel = grid.pixel_of_image(positions, image, num_images, torch.tensor([True, True]))
    assert pixel.tolist() == [0, (num_images - 1) * area + 1999 * grid.width + 1999]
    left_out = grid.pixel_of_image(positions, image, num_images, torch.tensor([False, False]))
    assert left_out.tolist() == [num_images * area] * 2


@pytest.mark.parametrize(
    "size, upper", [(1e-4, 35.0), (0.1, 4000.0), (1e-300, 1.0)], ids=["many pixels", "a long side", "tiny pixels"]
)
def test_too_large_grids_are_refused(size, upper):
    with pytest.raises(CFlowError, match="too large.*point_cloud_range or larger pixel_sizes"):
        Grid(size, (0.0, 0.0, -INF), (upper, 1.0, INF))
