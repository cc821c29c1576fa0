"""Slow objects: the oracle's answers; slow motion is found, rest stays rest."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import Scene, moving_scene, one_object
from oracle import slow_motion as oracle

from cflow_torch.verified.slow_motion import slow_motion


def found(scene: Scene) -> torch.Tensor:
    return slow_motion(scene.sweeps, scene.objects, torch.ones(len(scene.flow), dtype=torch.bool))


def expected(scene: Scene) -> torch.Tensor:
    flows = []
    for window in scene.windows():
        members = [[p for p, own in window.object_of.items() if own == i] for i in range(window.num_objects)]
        asked = [oracle.leans(window.sweeps, own) for own in members]
        points = window.points(asked, window.sweeps.pixel_size, oracle.NUM_LAYERS)
        flows += [flow or (0.0, 0.0) for flow in oracle.slow_motion(points, window.num_objects, window.sweeps)]
    return torch.tensor(flows, dtype=torch.float64).view(-1, 2)


def slow_scene(seeds, snap: float = 0.0, pixel_size: float = 0.1) -> Scene:
    return moving_scene(seeds, 2, pixel_size, snap, num_points=150, speed=0.08, size=(0.2, 0.8))


@pytest.mark.parametrize("snap", [0.0, 1 / 16])
@pytest.mark.parametrize("pixel_size, num_windows", [(0.1, 4), (0.2, 16)])
def test_equals_the_oracle(pixel_size, num_windows, snap):
    scene = slow_scene(range(num_windows), snap, pixel_size)
    flow = found(scene)
    assert torch.allclose(flow, expected(scene), rtol=0, atol=1e-9)
    assert 0 < int(flow.any(1).sum()) < len(flow)


def person(shift, rng) -> np.ndarray:
    """An upright cylinder, sampled anew."""
    angle, height = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0.0, 1.5, 400)
    return np.stack((0.25 * np.cos(angle) + shift[0], 0.25 * np.sin(angle) + shift[1], height), 1)


@pytest.mark.parametrize("truth", [(0.07, 0.0), (0.0, -0.09), (-0.05, 0.06), (0.12, 0.1)])
def test_finds_a_slow_person(truth):
    rng = np.random.default_rng(0)
    clouds = [person(truth, rng), person((0.0, 0.0), rng)]
    flow = found(one_object(clouds, (0.0, 0.0)))[0].numpy()
    assert np.linalg.norm(flow - truth) < 0.025
    later = found(one_object(clouds, (0.0, 0.0), (0.0, 2.0)))[0].numpy()  # the same way in twice the time
    np.testing.assert_allclose(later, flow / 2, atol=1e-12)


def test_rest_stays_rest():
    """Sampled anew thirty times, a person who stands is never moved."""
    rng = np.random.default_rng(1)
    scenes = [one_object([person((0.03, 0.02), rng), person((0.03, 0.02), rng)], (0.0, 0.0)) for _ in range(30)]
    assert sum(bool(found(scene).any()) for scene in scenes) == 0
