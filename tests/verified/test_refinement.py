"""Refinement: registration equals the oracle and finds known motions; slow objects move, static ones do not."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from moving_scenes import Scene, from_images, moving_scene, one_object
from oracle import registration as oracle

from cflow_torch.ops import chunks
from cflow_torch.ops.groups import Groups
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import find_components
from cflow_torch.verified.refinement import Registration, refine
from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.verified.selection import number_objects
from cflow_torch.verified.slow_objects import find_slow
from cflow_torch.verified.voxel_centroids import Voxels, covariance_of


def registered(scene: Scene) -> RigidMotion:
    return Registration.of_objects(scene.points(), scene.sweeps, len(scene.flow)).align(scene.flow)


def assert_equals_oracle(scene: Scene) -> RigidMotion:
    found = registered(scene)
    expected = [motion for window in scene.windows() for motion in oracle.register(*window)]
    for name in ("flow", "rotation", "centre"):
        values = np.array([getattr(motion, name) for motion in expected])
        np.testing.assert_allclose(getattr(found, name), values.reshape(getattr(found, name).shape), atol=1e-6)
    return found


@pytest.mark.parametrize("num_steps", [2, 4])
@pytest.mark.parametrize("snap", [0.0, 1 / 16])
def test_equals_the_oracle(snap, num_steps):
    moved = 0
    for pixel_size in (0.1, 0.2):
        scene = moving_scene(range(5), num_steps, pixel_size, snap)
        found = assert_equals_oracle(scene)
        moved += int(((found.flow != scene.flow).any(1) & (found.rotation != 0)).sum())
    assert moved > 5


@pytest.mark.parametrize("at_once", [pytest.param(9, marks=pytest.mark.slow), 100, 1000])
def test_chunks_do_not_change_a_bit(at_once, monkeypatch):
    scene = moving_scene(range(5), 4, 0.1)
    timed = replace(scene.points(), time=scene.points().position[0] / 10)

    def results() -> tuple[torch.Tensor, ...]:
        registration = Registration.of_objects(timed, scene.sweeps, len(scene.flow))
        motion = registration.align(scene.flow)
        better = registration.improves(motion, torch.ones(len(scene.flow), dtype=torch.bool))
        covariance = covariance_of(Voxels.of(timed, scene.sweeps))
        return motion.flow, motion.rotation, registration.stretch(motion), better, covariance

    expected = results()
    monkeypatch.setattr(chunks, "CHUNK_ON_CPU", at_once)
    assert all(map(torch.equal, results(), expected))


def sides(angle: float, x: float, y: float) -> np.ndarray:
    """(N, 3) points 0.1 m apart on the sides of a box of 2.5 m x 1.5 m, in four rings, rotated about the origin and
    moved."""
    u, v = np.arange(-1.25, 1.3, 0.1), np.arange(-0.75, 0.8, 0.1)
    ends = [np.stack([np.full(len(v), end), v], 1) for end in (-1.25, 1.25)]
    xy = np.concatenate([np.stack([u, np.full(len(u), end)], 1) for end in (-0.75, 0.75)] + ends)
    cos, sin = math.cos(angle), math.sin(angle)
    rotated = xy @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    rings = [np.concatenate([rotated, np.full((len(rotated), 1), z)], 1) for z in (0.25, 0.55, 0.85, 1.15)]
    return np.concatenate(rings)


def test_a_known_motion_is_found():
    """Of a rotating box, what holds on to no rotation leaves a tenth of it at most."""
    angle, clouds = 0.06, [sides(0.06, 0.43, 0.13), sides(0.0, 0.03, 0.03)]
    truth = torch.from_numpy(clouds[0] - clouds[1])[:, :2]
    scene = one_object(clouds, truth.mean(0).tolist())
    found = assert_equals_oracle(scene)
    assert abs(2 * math.atan(float(found.rotation[0])) - angle) < 0.1 * angle
    old = torch.from_numpy(clouds[1])
    flow = found.flow_at(torch.zeros(len(old), dtype=torch.int64), old[:, :2].t())
    assert (flow - truth).norm(dim=1).mean() < 0.1 * (scene.flow - truth).norm(dim=1).mean()


def test_the_motion_of_a_fast_object_is_found_between_the_pixels():
    rng = np.random.default_rng(0)
    old = np.concatenate([rng.uniform(-0.5, 0.5, (400, 2)) * (1.6, 0.9), rng.uniform(0, 1.4, (400, 1))], 1)
    for truth in ((0.23, 0.31), (-0.16, 0.38), (0.125, 0.07)):
        found = assert_equals_oracle(one_object([old + (*truth, 0.0), old], np.round(np.array(truth), 1)))
        assert (found.flow[0] - torch.tensor(truth)).abs().max() < 0.02


def test_an_object_without_pairs_keeps_its_motion():
    cloud = np.array([[0.05, 0.05, 0.2], [0.15, 0.05, 0.2]])
    found = assert_equals_oracle(one_object([cloud + (2.0, 0.0, 0.0), cloud], (0.5, 0.0)))
    assert found.flow.tolist() == [[0.5, 0.0]] and found.rotation.tolist() == [0.0]


def test_an_object_rotates_about_its_moving_centre():
    """Of sweeps t+1, t and t-1 at a constant turn and speed: all pairs agree."""
    angle, shift = 0.04, (0.4, -0.2)
    clouds = [sides(k * angle, k * shift[0], k * shift[1]) for k in (1, 0, -1)]
    found = assert_equals_oracle(one_object(clouds, shift))
    assert (found.flow[0] - torch.tensor(shift)).abs().max() < 2e-3
    assert abs(2 * math.atan(float(found.rotation[0])) - angle) < 0.1 * angle


def found(scene: Scene) -> np.ndarray:
    """(G, 2), metres per sweep interval, from rest."""
    rigid, _ = refine(scene.sweeps, scene.objects, torch.zeros_like(scene.flow), None)
    return rigid.flow.numpy()


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


@pytest.mark.parametrize("longest, moves", [(0.45, False), (0.65, True), (None, True)])
def test_long_static_objects_stay_static(longest, moves):
    rng = np.random.default_rng(0)
    scene = one_object([person((0.1, 0.0), rng), person((0.0, 0.0), rng)], (0.0, 0.0))
    nothing = torch.zeros(scene.sweeps.num_pixels, dtype=torch.bool)
    components = find_components(scene.sweeps, ChangedPixels(nothing, nothing, nothing), (1,))
    objects = number_objects(scene.sweeps, components.of_level(0))
    rigid, _ = refine(scene.sweeps, objects, torch.zeros_like(scene.flow), longest)
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


def slow_start(
    side: tuple[int, int], ahead: int, behind: int = 0, both: int = 0, alone: int = 0, slices: int = 1
) -> list[float]:
    """The first motion, in pixels (row, col), of lone pixels: so many have a pixel at t+1 at a side, at the opposite
    side, at both, at none. Those at t+1 count as well, and all are of one object."""
    images = np.zeros((1, 2, 60, 60), dtype=np.uint8)
    rows, cols = np.divmod(np.arange(ahead + behind + both + alone), 14)
    for i, (row, col) in enumerate(zip(4 * rows + 2, 4 * cols + 2)):
        images[0, 1, row, col] = slices
        for sign, wanted in ((1, i < ahead or 0 <= i - ahead - behind < both), (-1, 0 <= i - ahead < behind + both)):
            if wanted:
                images[0, 0, row + sign * side[0], col + sign * side[1]] = slices
    sweeps = from_images(images)
    objects = number_objects(sweeps, Groups(sweeps.pixels.window, 1))
    (start,) = find_slow(sweeps, objects, torch.zeros((1, 2)).double(), None)
    return (start.flip(0) / sweeps.grid.pixel_size).tolist()


@pytest.mark.parametrize("side", [(0, 1), (1, -1), (1, 0), (1, 1), (0, -1), (-1, 1), (-1, 0), (-1, -1)])
def test_an_object_starts_one_pixel_ahead_if_more_is_matched_there_than_behind(side):
    """a = 2 ahead + both, b = 2 behind + both; the bias is 3 standard deviations and a tenth of the slices."""
    start = partial(slow_start, side)
    static = [0.0, 0.0]
    assert start(5) == list(side) and start(4) == static
    assert start(2, slices=7) == list(side) and start(1, slices=7) == static
    assert start(11, behind=3) == list(side) and start(11, behind=4) == static
    assert start(3, behind=11) == [-side[0], -side[1]]
    assert start(9, both=9) == list(side) and start(9, both=10) == static
    assert start(5, alone=90) == list(side) and start(5, alone=91) == static


@pytest.mark.parametrize("count, moved, is_better", [(10, 0.011, True), (10, 0.01, False), (9, 0.04, False)])
def test_a_motion_must_gain_enough_and_more_than_noise(count, moved, is_better):
    """Of points alone in their surroundings: a distance of 0.011 m costs 0.031 of a match, 0.01 m costs 0.026. Equal
    gains of n voxels are n ** 0.5 standard deviations."""
    row, col = np.divmod(np.arange(count), 6)
    cloud = np.stack((0.8 * col - 2.75, 0.6 * row - 1.75, np.full(count, 0.05)), 1)
    scene = one_object([cloud + (moved, 0.0, 0.0), cloud], (moved, 0.0))
    registration = Registration.of_objects(scene.points(), scene.sweeps, 1)
    truth = RigidMotion(scene.flow, torch.zeros(1).double(), torch.zeros(1, 2).double())
    assert registration.improves(truth, torch.tensor([True])).tolist() == [is_better]
    assert registration.improves(truth, torch.tensor([False])).tolist() == [False]
