"""Ego motion: transforms in float64 against matrix products, and invalid transforms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import pose

from cflow_torch import CFlowError
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import compensate, relative_transform, rigid_transform


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
        (np.eye(4)[:3], r"T has shape \(3, 4\)"),
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
        (torch.float64, 1e7, False),
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
