"""Rigid registration: the oracle's motion; known motions are found."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from moving_scenes import Scene, moving_scene, one_object
from oracle import registration as oracle

from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.verified.rigid_registration import VoxelPairs


def registered(scene: Scene) -> RigidMotion:
    return VoxelPairs(scene.points(), scene.sweeps, len(scene.flow)).register(scene.flow)


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
        scene = moving_scene(range(8), num_steps, pixel_size, snap)
        found = assert_equals_oracle(scene)
        moved += int(((found.flow != scene.flow).any(1) & (found.rotation != 0)).sum())
    assert moved > 5


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
    flow = torch.stack(found.flow_at(torch.zeros(len(old), dtype=torch.int64), old[:, 0], old[:, 1]), 1)
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
