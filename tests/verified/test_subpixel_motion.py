"""Sub-pixel motion of pairs: the oracle's; slow objects have theirs, static ones none, moving ones keep theirs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import Scene, moving_scene, one_object
from oracle.subpixel_motion import subpixel_motion as oracle_motion

from cflow_torch.verified.subpixel_motion import subpixel_motion


def start(scene: Scene, moves: torch.Tensor) -> torch.Tensor:
    """(G, 2), (y, x) pixels per interval: whole pixels for what moves, 0 for the others."""
    return torch.floor(scene.flow.flip(1) / scene.sweeps.grid.pixel_size + 0.5) * moves[:, None]


def found(scene: Scene) -> np.ndarray:
    """(G, 2), metres, from rest."""
    every = torch.ones(len(scene.flow), dtype=torch.bool)
    return subpixel_motion(scene.sweeps, scene.objects, start(scene, ~every), every).numpy()


@pytest.mark.parametrize("snap", [0.0, 1 / 16])
@pytest.mark.parametrize("pixel_size, speed, num_windows", [(0.1, 0.08, 4), (0.2, 0.08, 12), (0.1, 0.4, 4)])
def test_equals_the_oracle(pixel_size, speed, num_windows, snap):
    scene = moving_scene(range(num_windows), 2, pixel_size, snap, num_points=150, speed=speed, size=(0.2, 0.8))
    moves = (start(scene, torch.ones(len(scene.flow))) != 0).any(1) & (torch.arange(len(scene.flow)) % 5 > 0)
    may_be_slow, given = torch.arange(len(scene.flow)) % 7 > 0, start(scene, moves)
    flow, expected, first = subpixel_motion(scene.sweeps, scene.objects, given, may_be_slow), [], 0
    for window in scene.windows():
        mine = slice(first, first + window.num_objects)
        motions = [(y, x) for y, x in given[mine].tolist()]
        expected += oracle_motion(window.sweeps, window.object_of, motions, may_be_slow[mine].tolist())
        first = mine.stop
    np.testing.assert_allclose(flow, np.array(expected).reshape(-1, 2), atol=1e-9)
    slow = flow.any(1) & ~moves
    assert int(slow.sum()) < int((~moves).sum()) or speed > 0.1
    assert not flow[~moves & ~may_be_slow].any() and torch.equal(flow[moves], given.flip(1)[moves] * pixel_size)


def test_windows_with_history_keep_their_motion():
    scene = moving_scene([3, 4], 3, num_points=150, speed=0.08, size=(0.2, 0.8))
    given = start(scene, torch.arange(len(scene.flow)) % 2)
    flow = subpixel_motion(scene.sweeps, scene.objects, given, torch.ones(len(given), dtype=torch.bool))
    assert torch.equal(flow, given.flip(1) * 0.1)


def person(shift, rng) -> np.ndarray:
    """An upright cylinder, sampled anew."""
    angle, height = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0.0, 1.5, 400)
    return np.stack((0.25 * np.cos(angle) + shift[0], 0.25 * np.sin(angle) + shift[1], height), 1)


@pytest.mark.parametrize("truth", [(0.07, 0.0), (0.0, -0.09), (-0.05, 0.06), (0.12, 0.1)])
def test_a_slow_person_is_found(truth):
    rng = np.random.default_rng(0)
    clouds = [person(truth, rng), person((0.0, 0.0), rng)]
    (flow,) = found(one_object(clouds, (0.0, 0.0)))
    assert np.linalg.norm(flow - truth) < 0.025
    later = found(one_object(clouds, (0.0, 0.0), (0.0, 2.0)))[0]  # the same way in twice the time
    np.testing.assert_allclose(later, flow / 2, atol=1e-12)


def test_a_static_person_stays_static():
    """Sampled anew thirty times."""
    rng = np.random.default_rng(1)
    scenes = [one_object([person((0.03, 0.02), rng), person((0.03, 0.02), rng)], (0.0, 0.0)) for _ in range(30)]
    assert not any(found(scene).any() for scene in scenes)
