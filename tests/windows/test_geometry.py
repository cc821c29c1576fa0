"""The BEV grid and ego motion: pixels of the oracle where rounding decides, transforms, size limits, bad transforms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.pixels import bev_dims, project_bev
from scenes import config, pose

from cflow_torch import CFlowError
from cflow_torch.transforms import relative_transform, rigid_transform
from cflow_torch.windows.bev_grid import Grid, Lattice
from cflow_torch.windows.ego_motion import compensate

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


def test_cells_are_numbered_image_after_image_in_raster_order():
    lattice = Lattice(2, 3, border=1)
    numbers = torch.tensor([[6, 7, 8, 11, 12, 13], [26, 27, 28, 31, 32, 33]])  # the picture in its docstring
    image = torch.arange(2)[:, None].expand(2, 6)
    row, col = torch.arange(6).expand(2, 6) // 3, torch.arange(6).expand(2, 6) % 3
    assert torch.equal(lattice.cell(image, row, col), numbers)
    assert torch.equal(lattice.cell(1, row.int(), col.int()), numbers[1].expand(2, 6).int())
    split = lattice.split(numbers)
    assert torch.equal(split[0], image) and torch.equal(split[1], torch.stack((row, col)))
    assert lattice.split(torch.tensor([0]))[1].tolist() == [[-1], [-1]]  # in the border
    assert (lattice.start(0), lattice.start(1), lattice.area) == (6, 26, 20)
    assert (12 + lattice.square(1, torch.device("cpu"))[:, 0]).tolist() == [6, 7, 8, 11, 12, 13, 16, 17, 18]
    grid = Grid(0.5, (0.0, 0.0, -1.0), (4.0, 2.0, 1.0))  # 5 rows and 9 columns
    assert grid.lattice() == Lattice(5, 9) and grid.lattice(2, border=1) == Lattice(3, 5, 1)


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


def random_transform(rng: np.random.Generator) -> np.ndarray:
    T, rotation = np.eye(4), np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, :3], T[:3, 3] = rotation * np.sign(np.linalg.det(rotation)), rng.normal(0, 50, 3)
    return T


def test_compensation_equals_the_matrix_product_and_keeps_its_input():
    rng = np.random.default_rng(0)
    T, p = random_transform(rng), rng.normal(0, 60, (3, 1000))
    given = torch.from_numpy(p.copy())
    assert np.allclose(compensate(given, T), T[:3, :3] @ p + T[:3, 3:], rtol=0, atol=1e-11)
    assert (given.numpy() == p).all() and torch.equal(compensate(given, None), given)


def test_two_axes_have_the_bits_of_three():
    rng = np.random.default_rng(3)
    given, T = torch.from_numpy(rng.normal(0, 30, (3, 400))), random_transform(rng)
    broken = torch.tensor([np.nan, np.inf, -np.inf, np.nan] * 10).double()
    given[rng.integers(0, 3, 40), rng.integers(0, 400, 40)] = broken
    whole, flat = compensate(given, T), compensate(given, torch.from_numpy(T), num_axes=2)
    assert torch.equal(whole[:2].nan_to_num(7.0), flat.nan_to_num(7.0))
    grid = Grid(0.5, (-60.0, -60.0, -np.inf), (60.0, 60.0, np.inf))
    # A z that is not finite spreads to x and y.
    assert torch.equal(grid.contains(whole), grid.contains(flat)) and 0 < grid.contains(whole).sum() < 400


def test_a_relative_transform_maps_through_the_world():
    # Sensor at (10, 5), facing left, then 2 m further along its own x axis.
    pose0, pose1 = pose(10, 5, np.pi / 2), pose(10, 7, np.pi / 2)
    moved = relative_transform(torch.from_numpy(pose1), pose0.tolist()) @ [1.0, 0.0, 0.0, 1.0]
    assert np.allclose(moved, [-1.0, 0.0, 0.0, 1.0], atol=1e-12)


@pytest.mark.parametrize(
    "matrix, complaint",
    [
        (np.eye(4)[None], r"T has shape \(1, 4, 4\).*no batch"),
        (np.eye(4)[:3], r"T has shape \(3, 4\).*append its last row: np.vstack"),
        (np.diag([1.0, 1.0, np.inf, 1.0]), "T holds NaN or inf"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "T is not rigid"),
        (np.diag([1.0, -1.0, 1.0, 1.0]), "T is not rigid"),
        (pose(3.0, 0, 0).T, "T is not rigid.*row-major"),
        ("eye", "T is str"),
        ([[1, 2], [3]], "T is list"),
    ],
)
def test_invalid_transforms_are_named(matrix, complaint):
    with pytest.raises(CFlowError, match=complaint):
        rigid_transform(matrix, "T")


@pytest.mark.parametrize(
    "dtype, x, refused",
    [
        (np.float64, 1e7, False),
        (np.float32, 1e5, False),  # 8 mm
        (np.float32, 2e5, True),  # 16 mm
        (torch.bfloat16, 0.0, True),  # 31 mm at the end of a region of 8 m
    ],
)
def test_too_coarse_types_of_poses_are_refused(dtype, x, refused):
    T = pose(x, 1.0, 0.0)
    given = torch.from_numpy(T).to(dtype) if isinstance(dtype, torch.dtype) else T.astype(dtype)
    if not refused:
        assert rigid_transform(given, "T", 8.0)[0, 3] == x
        return
    with pytest.raises(CFlowError, match=r"T is .*only holds multiples of .*float64"):
        rigid_transform(given, "T", 8.0)
