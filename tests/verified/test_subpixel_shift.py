"""Sub-pixel shift of objects: the oracle's; known shifts are found."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import Scene, moving_scene, one_object
from oracle.subpixel_shift import shift_between_pixels as oracle_shift

from cflow_torch.verified.subpixel_shift import shift_between_pixels


def shifted(scene: Scene) -> torch.Tensor:
    return shift_between_pixels(scene.points(), scene.sweeps, scene.in_pixels())


def expected(scene: Scene) -> torch.Tensor:
    found = [flow for w in scene.windows() for flow in oracle_shift(w.points(), w.flow_in_pixels, w.sweeps)]
    return torch.tensor(found, dtype=torch.float64).view(-1, 2)


@pytest.mark.parametrize("num_points", [2, 40])
@pytest.mark.parametrize("snap", [0.0, 1 / 16, 0.05])
def test_equals_the_oracle(snap, num_points):
    """Of few points an object most counts are equal."""
    moved = 0
    for num_steps, pixel_size in ((2, 0.1), (4, 0.2)):
        scene = moving_scene(range(10), num_steps, pixel_size, snap, num_points=num_points)
        found = shifted(scene)
        assert torch.allclose(found, expected(scene), rtol=0, atol=1e-9)
        moved += int((found - torch.floor(scene.in_pixels() + 0.5)).abs().ge(0.75).any(1).sum())
    assert moved > 0


def test_a_known_shift_is_found_to_a_fifth_of_a_pixel():
    """A dense object moved by a fraction of a pixel, from two thirds of a pixel off."""
    rng = np.random.default_rng(0)
    old = np.concatenate([rng.uniform(-0.5, 0.5, (400, 2)) * (1.6, 0.9), rng.uniform(0, 1.4, (400, 1))], 1)
    for y, x in ((3.0, 2.0), (3.5, -2.0), (0.75, 1.25), (-4.25, 0.5)):
        scene = one_object([old + (0.1 * x, 0.1 * y, 0.0), old], (0.1 * x + 0.06, 0.1 * y - 0.06))
        assert (shifted(scene) - torch.tensor([[y, x]])).abs().max() < 0.2
