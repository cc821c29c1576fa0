"""Motion by changed pixels: a walker beside a wall moves; the wall, and shadows on it, do not."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import pose

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.verified import changed_pixels, method
from cflow_torch.verified.changed_pixels import ChangedPixels

MODEL = make_config("default", point_cloud_range=(-10.0, -10.0, -3.0, 10.0, 10.0, 8.0))


def beside_a_wall(speed: float, density: float) -> tuple[Window, np.ndarray]:
    """A walker 0.2 m before a wall of so many points a square metre, six sweeps, the sensor drives; which points of t
    are the walker's. Its points lie at y < 2.9 m."""
    rng = np.random.default_rng(7)
    walker = rng.uniform((-0.25, -0.2, -1.6), (0.25, 0.2, 0.1), (200, 3)) + [4.0, 2.6, 0.0]
    wall, sweeps = rng.uniform((-9, 3.0, -1.6), (9, 3.1, 1.0), (int(46.8 * density), 3)), []
    for k in range(6):  # t+1 first
        T_world_ego = pose(-0.5 * k, 0.0, 0.0)
        moved, seen = walker[rng.random(200) < 0.7] - (speed * k, 0.0, 0.0), wall[rng.random(len(wall)) < 0.7]
        points = np.concatenate((moved, seen)) + rng.normal(0, 0.01, (len(moved) + len(seen), 3)) - T_world_ego[:3, 3]
        sweeps.append((Sweep(points.astype(np.float32), pose=T_world_ego), np.arange(len(points)) < len(moved)))
    (newest, _), (own, is_walker), *older = sweeps
    return Window(own, newest, tuple(sweep for sweep, _ in older)), is_walker


def nothing(sweeps) -> ChangedPixels:
    """All may move, and nothing has changed."""
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    return ChangedPixels(every, ~every)


def test_a_pedestrian_next_to_a_wall_moves_and_the_wall_is_static(monkeypatch):
    window, is_walker = beside_a_wall(0.13, 20.0)
    flow = VerifiedFlow(MODEL)([window])[0].residual_flow.numpy()
    moves = flow.any(1)
    assert moves[is_walker].mean() > 0.95 and np.abs(np.median(flow[is_walker], 0) - (0.13, 0.0, 0.0)).max() < 0.05
    assert moves[~is_walker].mean() < 0.02
    with monkeypatch.context() as patch:  # without the pixels that did not change
        patch.setattr(method, "add_unchanged", lambda sweeps, nodes, *of_nodes: nodes)
        assert 0.6 < VerifiedFlow(MODEL)([window])[0].residual_flow.any(1)[is_walker].double().mean() < 0.8
    monkeypatch.setattr(method, "find_changed", nothing)
    assert VerifiedFlow(MODEL)([window])[0].residual_flow.any(1)[is_walker].double().mean() < 0.2


def shadowed(seed: int, speed: float) -> Window:
    """A wall behind a parked car that hides part of it from a sensor that drives past."""
    rng = np.random.default_rng(seed)
    car = rng.uniform((-2.0, 3.0, -1.6), (2.0, 4.6, -0.1), (2500, 3))
    wall, sweeps = rng.uniform((-9.5, 7.0, -1.6), (9.5, 7.1, 0.5), (9000, 3)), []
    for k in range(6):
        T_world_ego = pose(-speed * k, 0.0, 0.0)
        sensor = T_world_ego[:3, 3]
        seen = wall[rng.random(9000) < 0.8]
        # Where the way from the sensor to a point of the wall goes through the side of the car.
        share = (3.0 - sensor[1]) / (seen[:, 1] - sensor[1])
        x, z = sensor[0] + share * (seen[:, 0] - sensor[0]), sensor[2] + share * (seen[:, 2] - sensor[2])
        hidden = (np.abs(x) < 2.0) & (z < -0.1)
        points = np.concatenate((car[rng.random(2500) < 0.8], seen[~hidden])) - sensor
        sweeps.append(Sweep(points.astype(np.float32), pose=T_world_ego))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


@pytest.mark.parametrize("speed", [0.15, 0.18, 0.5])
def test_shadows_of_a_parked_car_do_not_move_the_wall(speed, monkeypatch):
    model, window = VerifiedFlow(MODEL), shadowed(0, speed)
    assert not model([window])[0].residual_flow.any()
    if speed != 0.18:
        return
    # If every sweep saw everything, the edges of the shadow would be changed pixels, which move.
    monkeypatch.setattr(changed_pixels.RangeImages, "farther", lambda self, image, at: torch.ones_like(at[0]).float())
    assert model([window])[0].residual_flow.any()
