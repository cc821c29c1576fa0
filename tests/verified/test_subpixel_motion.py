"""Sub-pixel motion of pairs: slow objects have theirs, static ones none; windows with history keep theirs."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import Scene, one_object

from cflow_torch.verified.subpixel_motion import subpixel_motion


def found(scene: Scene) -> np.ndarray:
    """(G, 2), metres, from rest."""
    every = torch.ones(len(scene.flow), dtype=torch.bool)
    return subpixel_motion(scene.sweeps, scene.objects, torch.zeros_like(scene.flow), every).numpy()


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


def test_windows_with_history_keep_their_motion():
    rng = np.random.default_rng(0)
    scene = one_object([person((0.07 * k, 0.0), rng) for k in (1, 0, -1)], (0.0, 0.0))
    assert not found(scene).any() and scene.sweeps.has_history.all()


def test_a_static_person_stays_static():
    """Sampled anew thirty times."""
    rng = np.random.default_rng(1)
    scenes = [one_object([person((0.03, 0.02), rng), person((0.03, 0.02), rng)], (0.0, 0.0)) for _ in range(30)]
    assert not any(found(scene).any() for scene in scenes)
