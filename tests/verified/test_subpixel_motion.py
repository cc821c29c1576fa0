"""Sub-pixel motion of pairs: slow objects have theirs, static ones none; the limits of the tests, by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import Scene, from_images, one_object

from cflow_torch.verified import subpixel_motion as fast
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import find_components, number_objects
from cflow_torch.verified.refinement import refine
from cflow_torch.verified.voxel_centroids import Voxels, points_of_objects


def found(scene: Scene) -> np.ndarray:
    """(G, 2), metres, from rest."""
    every = torch.ones(len(scene.flow), dtype=torch.bool)
    return fast.subpixel_motion(scene.sweeps, scene.objects, torch.zeros_like(scene.flow), every).numpy()


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


@pytest.mark.parametrize("longest, moves", [(0.45, False), (0.65, True), (None, True)])
def test_long_static_objects_stay_static(longest, moves):
    rng = np.random.default_rng(0)
    scene = one_object([person((0.1, 0.0), rng), person((0.0, 0.0), rng)], (0.0, 0.0))
    nothing = torch.zeros(scene.sweeps.num_pixels, dtype=torch.bool)
    components = find_components(scene.sweeps, ChangedPixels(nothing, nothing), (1,))
    objects = number_objects(components.roots[0], components.count)
    rigid, _ = refine(scene.sweeps, components, objects, torch.zeros_like(scene.flow), longest)
    assert bool(rigid.flow.any()) == moves


def test_windows_with_history_keep_their_motion():
    rng = np.random.default_rng(0)
    scene = one_object([person((0.07 * k, 0.0), rng) for k in (1, 0, -1)], (0.0, 0.0))
    assert not found(scene).any() and scene.sweeps.has_history.all()


def test_a_static_person_stays_static():
    """Sampled anew thirty times."""
    rng = np.random.default_rng(1)
    scenes = [one_object([person((0.03, 0.02), rng), person((0.03, 0.02), rng)], (0.0, 0.0)) for _ in range(30)]
    assert not any(found(scene).any() for scene in scenes)


def is_biased(
    side: tuple[int, int], ahead: int, behind: int = 0, both: int = 0, alone: int = 0, slices: int = 1
) -> bool:
    """Whether lone pixels are biased: so many have a pixel at t+1 at a side, at the opposite side, at both, at none.
    Those at t+1 count as well, and all are of one object."""
    images = np.zeros((1, 2, 60, 60), dtype=np.uint8)
    rows, cols = np.divmod(np.arange(ahead + behind + both + alone), 14)
    for i, (row, col) in enumerate(zip(4 * rows + 2, 4 * cols + 2)):
        images[0, 1, row, col] = slices
        for sign, wanted in ((1, i < ahead or 0 <= i - ahead - behind < both), (-1, 0 <= i - ahead < behind + both)):
            if wanted:
                images[0, 0, row + sign * side[0], col + sign * side[1]] = slices
    sweeps = from_images(images)
    return bool(fast._is_biased(sweeps, number_objects(sweeps.pixels.window, 1), torch.tensor([True])))


@pytest.mark.parametrize("side", [(0, 1), (1, -1), (1, 0), (1, 1), (0, -1), (-1, 1), (-1, 0), (-1, -1)])
def test_an_object_is_biased_if_more_is_matched_ahead_than_behind(side):
    """a = 2 ahead + both, b = 2 behind + both; the bias is 3 standard deviations and a tenth of the slices."""
    assert is_biased(side, 5) and not is_biased(side, 4)
    assert is_biased(side, 2, slices=7) and not is_biased(side, 1, slices=7)
    assert is_biased(side, 11, behind=3) and not is_biased(side, 11, behind=4)
    assert is_biased(side, 9, both=9) and not is_biased(side, 9, both=10)
    assert is_biased(side, 5, alone=90) and not is_biased(side, 5, alone=91)


def shift_of(count: int, moved: float) -> list[float]:
    """The shift of so many points that move along x, each alone in its surroundings."""
    row, col = np.divmod(np.arange(count), 6)
    cloud = np.stack((0.8 * col - 2.75, 0.6 * row - 1.75, np.full(count, 0.05)), 1)
    scene = one_object([cloud + (moved, 0.0, 0.0), cloud], (0.0, 0.0))
    every = torch.ones(1, dtype=torch.bool)
    points = points_of_objects(scene.sweeps, scene.objects, every, 0.1, fast._NUM_LAYERS)
    shift = fast._significant_shift(Voxels(points, scene.sweeps, fast._NUM_LAYERS), 1)
    return (shift[0] / 1024).tolist()


@pytest.mark.parametrize("count, moved, found", [(12, 0.025, 0.025), (12, 0.02, 0.0), (9, 0.04, 0.04), (8, 0.04, 0.0)])
def test_a_shift_gains_enough_and_more_than_noise(count, moved, found, monkeypatch):
    """By exp(-d^2 / 2 sigma^2), 0.025 m gain 0.062 a cube, 0.02 m 0.039; 4 standard deviations are 17 cubes of 18."""
    monkeypatch.setattr(fast, "_STEP_LENGTH", 1.0)  # lone points need no longer steps
    np.testing.assert_allclose(shift_of(count, moved), (found, 0.0), atol=0.001)


def test_a_shift_is_bounded(monkeypatch):
    monkeypatch.setattr(fast, "_STEP_LENGTH", 1.0)
    assert shift_of(12, 0.19) == [154 / 1024, 0.0]
