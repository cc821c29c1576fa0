"""Nudging of large groups: the reference's bits; a motion that is a little off is put right, a small group is left."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import LOWER, Scene, as_scene, moving_scene, one_window
from oracle import nudge as ref

from cflow_torch.verified.nudge import _LEAST_CUBES, nudge


def nudged(scene: Scene) -> torch.Tensor:
    flow = scene.flow.flip(1) / scene.grid.pixel_size
    points = scene.moving()
    return nudge(points, scene.pixel_of_place, len(scene.group), scene.grid, scene.batch.elapsed, flow)


@pytest.mark.parametrize("snap", [0.0, 1 / 16])
def test_bits_of_the_reference(snap, monkeypatch):
    monkeypatch.setattr("cflow_torch.verified.nudge._LEAST_CUBES", 40)
    monkeypatch.setattr(ref, "LEAST_CUBES", 40)
    moved, kept = 0, 0
    for seed in range(12):
        scene = moving_scene(seed, 1, 2, 0.1, snap, num_points=150)
        found, start = nudged(scene), scene.flow.flip(1) / 0.1
        given = [tuple(values) for values in start.tolist()]
        expected = ref.nudge(scene.listed(), given, scene.batch.elapsed[0, 1].item(), LOWER[:2], 0.1)
        assert found.numpy().tobytes() == torch.tensor(expected, dtype=torch.float64).numpy().tobytes()
        moved += int((found != start).any(1).sum())
        kept += int((found == start).all(1).sum())
    assert moved > 1 and kept > 1


def test_batch_is_the_loop(monkeypatch):
    monkeypatch.setattr("cflow_torch.verified.nudge._LEAST_CUBES", 40)
    scene = moving_scene(3, 4, 2, 0.1, 1 / 16, num_points=150)
    together = nudged(scene)
    assert (together != scene.flow.flip(1) / 0.1).any()
    for window in range(4):
        alone, groups = one_window(scene, window)
        assert torch.equal(nudged(alone), together[groups])


def car(shift, rng, num_points) -> np.ndarray:
    """Sides of a box, sampled anew."""
    side, along = rng.integers(0, 4, num_points), rng.uniform(-0.5, 0.5, num_points)
    x = np.where(side < 2, along, np.where(side == 2, -0.5, 0.5)) * 4.0 + shift[0]
    y = np.where(side >= 2, along, np.where(side == 0, -0.5, 0.5)) * 1.8 + shift[1]
    return np.stack((x, y, rng.uniform(0.2, 1.5, num_points)), 1)


def test_puts_a_large_group_right_and_leaves_a_small_one():
    rng = np.random.default_rng(0)
    truth, start = np.array((0.53, 0.21)), np.array((0.49, 0.25))
    for num_points, is_large in ((3000, True), (90, False)):
        scene = as_scene([car(truth / 2, rng, num_points), car(-truth / 2, rng, num_points)], [start])
        found = nudged(scene)[0].flip(0).numpy() * 0.1
        if is_large:
            assert np.abs(found - truth).max() < 0.02
        else:
            np.testing.assert_array_equal(found, start / 0.1 * 0.1)
    assert _LEAST_CUBES == ref.LEAST_CUBES == 400
