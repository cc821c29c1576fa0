"""Relocation of groups: the reference's bits, whatever the order and the company; ties; known shifts are found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from moving_scenes import LOWER, Scene, as_scene, moving_scene, one_window
from oracle import relocation as ref
from scenes import needs_gpu

from cflow_torch.verified.subpixel_shift import relocate


def pixels(scene: Scene) -> torch.Tensor:
    """(G, 2) flow of a scene, (y, x) pixels."""
    return scene.flow.flip(1) / scene.grid.pixel_size


def relocated(scene: Scene) -> torch.Tensor:
    return relocate(scene.moving(), scene.grid, scene.batch.num_windows, pixels(scene))


def expected(scene: Scene) -> torch.Tensor:
    given = [(y, x) for y, x in pixels(scene).tolist()]
    found = ref.relocate(scene.listed(), given, LOWER[:2], scene.grid.pixel_size)
    return torch.tensor(found, dtype=torch.float64).view(-1, 2)


def assert_same_bits(found: torch.Tensor, wanted: torch.Tensor) -> None:
    assert found.shape == wanted.shape and found.dtype == wanted.dtype
    assert found.cpu().numpy().tobytes() == wanted.cpu().numpy().tobytes(), f"{found} is not {wanted}"


@pytest.mark.parametrize("num_steps", [2, 4])
@pytest.mark.parametrize("snap", [0.0, 1 / 16, 0.05])
@pytest.mark.parametrize("pixel_size", [0.1, 0.2])
def test_bits_of_the_reference(pixel_size, snap, num_steps):
    moved = 0
    for seed in range(5):
        scene = moving_scene(seed, 1 + seed % 3, num_steps, pixel_size, snap, num_points=(8, 40, 90)[seed % 3])
        found = relocated(scene)
        assert_same_bits(found, expected(scene))
        moved += int((found - torch.floor(pixels(scene) + 0.5)).abs().ge(0.75).any(1).sum())
    assert moved > 0


def test_few_points_tie():
    """One to three points an object: most counts are equal."""
    for seed in range(20):
        scene = moving_scene(seed, 3, 2, num_points=1 + seed % 3, snap=0.05)
        assert_same_bits(relocated(scene), expected(scene))


@pytest.mark.parametrize(
    "new, flow, expected_flow",
    [
        ([(0, 0)], (0.2, -0.3), (0.0, 0.0)),  # rounded to whole pixels
        ([(0, 1), (0, -1)], (0.0, 0.0), (0.0, -1.0)),  # equally near: the first in raster order
        ([(1, 1), (-1, 0)], (0.0, 0.0), (-1.0, 0.0)),  # the nearer one
        ([(1, 1), (-1, -1)], (0.0, 0.0), (-1.0, -1.0)),
        ([(2, 0)], (0.0, 0.0), (0.0, 0.0)),  # too far: nothing is met
        ([(2, 0)], (0.3, 0.2), (0.3, 0.2)),  # nothing is met: not rounded
        ([(2, 0)], (0.5, 0.0), (2.0, 0.0)),  # halves up, then one on
        ([(0, 0), (0, 1)], (0.0, 0.0), (0.0, 0.5)),  # the parabola goes half a pixel at most
    ],
)
def test_ties(new, flow, expected_flow):
    """One voxel at t, some at t+1, each at the same place of its pixel: the four grids count the same."""
    at = np.array([[0.02, 0.02, 0.2]])
    target = np.concatenate([at + (0.1 * dx, 0.1 * dy, 0.0) for dy, dx in new])
    scene = as_scene([target, at], [np.zeros(2)])
    given = torch.tensor([flow], dtype=torch.float64)
    found = relocate(scene.moving(), scene.grid, 1, given)
    assert found.tolist() == [list(expected_flow)]
    assert ref.relocate(scene.listed(), [flow], LOWER[:2], scene.grid.pixel_size) == [expected_flow]


def test_slices_do_not_meet_each_other():
    low, high = np.array([[0.02, 0.02, 0.2]]), np.array([[0.12, 0.02, 0.7]])
    scene = as_scene([high, low], [np.zeros(2)])
    given = torch.tensor([[0.1, 0.2]], dtype=torch.float64)
    assert torch.equal(relocate(scene.moving(), scene.grid, 1, given), given)


def test_a_known_shift_is_found_to_a_fifth_of_a_pixel():
    """A dense object moved by a fraction of a pixel, from two thirds of a pixel off."""
    rng = np.random.default_rng(0)
    old = np.concatenate([rng.uniform(-0.5, 0.5, (400, 2)) * (1.6, 0.9), rng.uniform(0, 1.4, (400, 1))], 1)
    for y, x in ((3.0, 2.0), (3.5, -2.0), (0.75, 1.25), (-4.25, 0.5)):
        scene = as_scene([old + (0.1 * x, 0.1 * y, 0.0), old], [np.array([0.1 * x + 0.06, 0.1 * y - 0.06])])
        found = relocated(scene)
        assert_same_bits(found, expected(scene))
        assert (found - torch.tensor([[y, x]])).abs().max() < 0.2


def test_order_of_points():
    scene = moving_scene(1, 2, 3, snap=0.05)
    points = scene.moving()
    order = torch.randperm(points.group.numel(), generator=torch.Generator().manual_seed(0))
    assert_same_bits(relocate(points.take(order), scene.grid, 2, pixels(scene)), relocated(scene))


def test_batch_is_the_loop():
    scene, seen = moving_scene(2, 4, 3, snap=1 / 16), 0
    together = relocated(scene)
    for window in range(4):
        alone, groups = one_window(scene, window)
        assert_same_bits(relocated(alone), together[groups])
        seen += len(groups)
    assert seen > 4


def test_no_groups_and_no_points():
    scene = moving_scene(0)
    assert relocated(scene._replace(group=torch.zeros_like(scene.group), flow=scene.flow[:0])).shape == (0, 2)
    nowhere = scene._replace(group=torch.full_like(scene.group, len(scene.flow)))
    assert_same_bits(relocated(nowhere), pixels(nowhere))


@needs_gpu
def test_same_bits_on_the_gpu():
    scene = moving_scene(4, 3, 4, snap=0.05)
    points = scene.moving()
    there = dataclasses.replace(points, **{f.name: getattr(points, f.name).cuda() for f in dataclasses.fields(points)})
    assert_same_bits(relocate(there, scene.grid, 3, pixels(scene).cuda()), relocated(scene))
