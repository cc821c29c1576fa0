"""Ego motion and the BEV grid, bit by bit."""

from __future__ import annotations

import math

import numpy as np
import oracle as ref
import pytest
import torch
from scenes import pose

from cflow_torch import CorrelationFlow, Sweep, Window
from cflow_torch.config import Config
from cflow_torch.types import CFlowError
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import compensate, relative_transform, rigid_transform

INF = math.inf


def random_rotation(rng) -> np.ndarray:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return rotation * np.sign(np.linalg.det(rotation))


# ------------------------------------------------------------------------------------------------ ego motion


def test_compensate_rounds_once_per_operation_in_the_stated_order():
    rng = np.random.default_rng(0)
    for _ in range(5):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = random_rotation(rng), rng.normal(0, 50, 3)
        p = rng.normal(0, 60, (3, 1000))
        given = torch.from_numpy(p.copy())
        found = compensate(given, T).numpy()
        for axis in range(3):
            expected = ((T[axis, 0] * p[0] + T[axis, 1] * p[1]) + T[axis, 2] * p[2]) + T[axis, 3]
            assert found[axis].tobytes() == expected.tobytes()
        assert np.allclose(found, T[:3, :3] @ p + T[:3, 3:], rtol=0, atol=1e-12 * 200)
        assert (given.numpy() == p).all()


def test_compensate_without_a_transform_changes_nothing():
    positions = torch.randn(3, 7, dtype=torch.float64)
    assert torch.equal(compensate(positions, None), positions)


def test_relative_transform_maps_through_the_world():
    # Sensor at (10, 5), facing left, then 2 m further along its own x axis.
    pose0, pose1 = pose(10, 5, np.pi / 2), pose(10, 7, np.pi / 2)
    moved = relative_transform(pose1, pose0) @ [1.0, 0.0, 0.0, 1.0]
    assert np.allclose(moved, [-1.0, 0.0, 0.0, 1.0], atol=1e-12)
    assert relative_transform(torch.from_numpy(pose1), pose0.tolist()).tobytes() == (
        (np.linalg.inv(pose1) @ pose0).tobytes()
    )


def test_rigid_transform_keeps_float64():
    T = pose(1e5 + 1e-7, 2.0, 0.3)
    assert rigid_transform(T, "T").tobytes() == T.tobytes()
    assert rigid_transform(T.astype(np.float32), "T").dtype == np.float64


@pytest.mark.parametrize(
    "matrix, complaint",
    [
        (np.eye(3), r"T has shape \(3, 3\)"),
        (np.eye(4)[None], r"T has shape \(1, 4, 4\).*no batch"),
        (np.eye(4)[:3], r"T has shape \(3, 4\)"),
        (np.full((4, 4), np.nan), "T holds NaN"),
        (np.diag([1.0, 1.0, np.inf, 1.0]), "T holds NaN or inf"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "T is not rigid"),
        (np.diag([1.0, -1.0, 1.0, 1.0]), "T is not rigid"),
        (np.zeros((4, 4)), "T is not rigid"),
        (pose(3.0, 0, 0).T, "T is not rigid.*row-major"),
        ("eye", "T is str"),
        ([[1, 2], [3]], "T is list"),
        (None, "T "),
    ],
)
def test_rigid_transform_names_what_is_wrong(matrix, complaint):
    with pytest.raises(CFlowError, match=complaint):
        rigid_transform(matrix, "T")


# ------------------------------------------------------------------------------------------------------ grid


@pytest.mark.parametrize("size", [0.1, 0.125, 0.3, 1 / 3, 1.0, 0.07])
def test_pixels_are_the_reference_s(size):
    lower, upper = (-35.0, -20.1, -INF), (35.0, 20.0, INF)
    grid = Grid(size, lower, upper)
    config = Config(pixel_sizes=(size,), point_cloud_range=(*lower, *upper))
    assert (grid.height, grid.width) == ref.bev_dims(config, size)
    rng = np.random.default_rng(1)
    edges = lower[0] + size * np.arange(grid.width)  # where rounding decides
    x = np.concatenate([rng.uniform(-35, 35, 5000), edges, np.nextafter(edges, 99), [-35.0, 35.0]]).clip(-35, 35)
    y = np.concatenate([rng.uniform(-20.1, 20, x.size - 2), [-20.1, 20.0]])
    points = np.stack([x, y, np.zeros_like(x)], 1)
    row, col = ref.project_bev(points, config, size).T
    raster = grid.pixel(torch.from_numpy(points.T.copy())).numpy()
    assert (raster == row * grid.width + col).all()
    assert raster.min() >= 0 and raster.max() < grid.height * grid.width
    assert col.max() == grid.width - 1  # the upper end belongs to the last pixel


def test_pixel_uses_a_true_division():
    # 0.7 / 0.1 = 6.999..., so 0.7 lies in column 6; times the reciprocal it would be column 7.
    grid = Grid(0.1, (0.0, 0.0, -INF), (2.0, 2.0, INF))
    x = torch.tensor([0.3, 0.6, 0.7, 1.7], dtype=torch.float64)
    assert grid.pixel(torch.stack((x, 0 * x, x))).tolist() == [math.floor(v / 0.1) for v in x.tolist()]


def test_dimensions_have_the_plus_one():
    grid = Grid(0.5, (-1.0, -2.0, -INF), (1.0, 3.0, INF))
    assert (grid.height, grid.width) == (11, 5)


def test_contains_includes_both_ends_and_no_nan():
    grid = Grid(0.5, (-1.0, -2.0, -3.0), (1.0, 2.0, 3.0))
    inside = [(-1, -2, -3), (1, 2, 3), (0, 0, 0)]
    beyond = [(np.nextafter(1, 2), 0, 0), (0, np.nextafter(-2, -3), 0), (0, 0, np.nextafter(3, 4)), (0, 0, -3.1)]
    broken = [(np.nan, 0, 0), (0, np.nan, 0), (0, 0, np.nan), (np.inf, 0, 0), (0, -np.inf, 0), (0, 0, np.inf)]
    points = torch.tensor(inside + beyond + broken, dtype=torch.float64).t()
    assert grid.contains(points).tolist() == [True] * 3 + [False] * 10


def test_open_z_range_takes_any_finite_height():
    grid = Grid(0.5, (-1.0, -2.0, -INF), (1.0, 2.0, INF))
    z = torch.tensor([-1e30, 0.0, 1e30, np.inf, -np.inf, np.nan], dtype=torch.float64)
    assert grid.contains(torch.stack((0 * torch.ones(6), 0 * torch.ones(6), z))).tolist() == [True] * 3 + [False] * 3
    half_open = Grid(0.5, (-1.0, -2.0, 0.0), (1.0, 2.0, INF))
    assert half_open.contains(torch.tensor([[0.0] * 3, [0.0] * 3, [-0.1, 0.0, 9e9]])).tolist() == [False, True, True]


def test_projection_draws_every_point_that_takes_part():
    grid = Grid(1.0, (0.0, 0.0, -INF), (3.0, 2.0, INF))  # 3 rows, 4 columns
    positions = torch.tensor([[0.5, 3.0, 2.2, 0.5, np.nan], [0.5, 2.0, 1.9, 0.7, 0.0], [0.0] * 5], dtype=torch.float64)
    takes_part = torch.tensor([True, True, False, True, False])
    occupancy, pixel = grid.project(positions, torch.tensor([0, 1, 1, 0, 1]), 2, takes_part)
    assert occupancy.shape == (2, 3, 4)
    assert occupancy.nonzero().tolist() == [[0, 0, 0], [1, 2, 3]]
    assert pixel.tolist() == [0, 12 + 11, 24, 0, 24]


def test_x_and_y_alone_are_those_of_the_whole_transform_and_region():
    rng = np.random.default_rng(3)
    given = torch.from_numpy(rng.normal(0, 30, (3, 400)))
    given[rng.integers(0, 3, 40), rng.integers(0, 400, 40)] = torch.tensor([np.nan, INF, -INF, np.nan] * 10).double()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = random_rotation(rng), rng.normal(0, 5, 3)
    whole, flat = compensate(given, T), compensate(given, torch.from_numpy(T), num_axes=2)
    assert torch.equal(whole[:2].nan_to_num(7.0), flat.nan_to_num(7.0))
    grid = Grid(0.5, (-20.0, -10.0, -INF), (10.0, 30.0, INF))
    inside = grid.contains(whole)
    assert 0 < inside.sum() < 400
    assert torch.equal(inside, grid.contains(flat))  # what is not finite in z is not finite in x and y either


@pytest.mark.parametrize("sectional_view", [False, True])
def test_the_length_of_a_piece_changes_nothing(monkeypatch, sectional_view):
    rng = np.random.default_rng(5)
    car = rng.uniform((0, 0, 0), (4, 2, 1.5), (600, 3))
    sweeps = []
    for step, seconds in enumerate((0.1, 0.0, -0.1)):
        points = np.concatenate((car + (2 + 6 * seconds, 1, 0), rng.uniform(-20, 20, (300, 3))))
        points[step] = np.nan
        pose = np.eye(4)
        pose[0, 3] = 5 * seconds
        sweeps.append(Sweep((points - pose[:3, 3]).astype(np.float32), rng.random(900) < 0.1, pose))
    window = Window(sweeps[1], sweeps[0], (sweeps[2],))
    small_region = (-15.0, -15.0, -10.0, 4.5, 15.0, 10.0)  # the car drives out of it
    overrides = {"num_history": 2, "pixel_sizes": (0.4, 0.2), "point_cloud_range": small_region}
    model = CorrelationFlow.from_preset("paper", **overrides, sectional_view=sectional_view)
    whole = model([window, window])
    monkeypatch.setattr("cflow_torch.ops.chunks.CHUNK_ON_CPU", 37)
    for expected, found in zip(whole, model([window, window])):
        assert expected.residual_flow.any()
        for name, values in expected.numpy().items():
            assert values.tobytes() == found.numpy()[name].tobytes(), name


def test_a_grid_that_nobody_can_hold_is_refused():
    with pytest.raises(CFlowError, match="point_cloud_range.*pixel_sizes"):
        Grid(1e-4, (-35.0, -35.0, -INF), (35.0, 35.0, INF))


def test_an_image_side_is_bounded():
    # 40,000 x 11 pixels are few, but shifts that long have no place in the order of ties.
    with pytest.raises(CFlowError, match="32768 a side"):
        Grid(0.1, (0.0, 0.0, -INF), (4000.0, 1.0, INF))
