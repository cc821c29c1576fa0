"""Changed pixels: what is missing, seen or hidden, by hand; walkers move, shadows do not."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import pytest
import torch
from scenes import pose, scene, sweeps_of

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified import changed_pixels, motion_margin
from cflow_torch.verified.changed_pixels import ChangedPixels, RangeImages, find_changed

REGION = (-20.0, -20.0, -3.0, 20.0, 20.0, 5.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION, num_history=3, min_height=None)


def screen(distance: float, half: float = 2.0, top: float = 0.0) -> np.ndarray:
    """Wide and dense, so far before a sensor that stands 1.6 m over the ground, which is at z = -2."""
    y, z = np.meshgrid(np.arange(-half, half, 0.02), np.arange(-2, top, 0.05))
    return np.stack((np.full(y.size, distance), y.ravel(), z.ravel()), 1)


def floor() -> np.ndarray:
    """Of 5 m, behind the sensor; so the lowest points tell how high the sensor is."""
    return np.stack((np.linspace(-10, -5, 500), np.zeros(500), np.full(500, -2.0)), 1)


def farther(clouds: Sequence[np.ndarray], places: Sequence[Sequence[float]], shift: float) -> list[list[float]]:
    """Of t+1 and of t, when the sensor was `shift` metres further left: by how much farther each sees than a place."""
    T_world_ego = pose(0.0, shift, 0.0)
    pc1, pc0 = (np.concatenate((cloud, floor())) for cloud in clouds)
    window = Window(Sweep(pc0 - T_world_ego[:3, 3], pose=T_world_ego), Sweep(pc1, pose=np.eye(4)))
    images = RangeImages(sweeps_of([window], SETTINGS))
    positions = torch.from_numpy(np.array(places, dtype=np.float64)).T
    return [images.farther(torch.full((len(places),), step), positions).tolist() for step in (0, 1)]


def test_positions_before_a_screen_are_seen_and_those_behind_are_occluded():
    seen, hidden, unknown = [(4, 0, -1), (4.9, 1, -1)], [(10, 0, -1), (10, 3.5, -1), (10, 0, 0.3)], [(10, 4.5, -1)]
    unknown += [(10, 0, 1.0), (0, 9, 0)]  # beside the screen, over its top, which rises from the sensor, to the left
    for values in farther([screen(5.0)] * 2, [*seen, *hidden, *unknown], 0.0):
        assert min(values[:2]) > 0 and max(values[2:5]) < -4 and min(values[2:5]) > -7
        assert values[5:] == [-np.inf] * 3


def test_occlusion_depends_on_the_sensor_position_of_each_sweep():
    # From 3 m further left the screen hides what is further right.
    left, right = (10.0, 3.5, -1.0), (10.0, -6.0, -1.0)
    newest, older = farther([screen(5.0)] * 2, [left, right], 3.0)
    assert -6 < newest[0] < -4 and newest[1] == -np.inf and older[0] == -np.inf and -7 < older[1] < -4


def block(x: float, y: float) -> np.ndarray:
    """1.5 m high, of 0.5 m sides, dense."""
    places = np.stack(np.meshgrid(np.arange(x, x + 0.5, 0.1), np.arange(y, y + 0.5, 0.1), np.arange(-2, -0.5, 0.1)), -1)
    return places.reshape(-1, 3)


def shares(sweeps: Sequence[np.ndarray], rows: tuple[float, float]) -> tuple[float, float, float]:
    """Share of the pixels at t with x in a range that are missing, have changed, and may be fast, in t+1, t, t-1."""
    pc1, pc0, older = (Sweep(np.concatenate((cloud, floor()))) for cloud in sweeps)
    images = sweeps_of([Window(pc0, pc1, (older,))], SETTINGS)
    found, x = find_changed(images), (images.pixels.row_col[1].double() + 0.5) * 0.25 - 20
    mine = (images.pixels.step == 1) & (x > rows[0]) & (x < rows[1])
    assert mine.sum() > 3
    return tuple(float(values[mine].double().mean()) for values in found)  # type: ignore[return-value]


def test_a_pedestrian_before_a_wall_has_changed_and_the_wall_has_not():
    walk = [np.concatenate((block(6.0, y), screen(8.0, 6.0, 0.5))) for y in (1.0, 0.0, -1.0)]
    assert shares(walk, (5.9, 6.6)) == (1.0, 1.0, 1.0)
    assert shares(walk, (7.9, 8.3)) == (0.0, 0.0, 0.0)


def test_a_pedestrian_behind_a_car_has_changed_only_if_seen_through_its_windows():
    # The walker is gone at t+1: behind the car nobody can tell; through its windows the wall shows.
    wall, car = screen(8.0, 6.0, 0.5), screen(3.0, 2.0, -0.1)
    hidden = [np.concatenate((car, wall)), np.concatenate((block(6.0, 0.0), wall)), np.concatenate((car, wall))]
    visible = wall[np.abs(wall[:, 1]) > 5.6]  # what the car does not hide
    hidden[0] = hidden[2] = np.concatenate((car, visible))
    assert shares(hidden, (5.9, 6.6)) == (0.0, 0.0, 1.0)
    hidden_once = [hidden[0], hidden[1], hidden[1] + (0, 0, 1e-4)]
    assert shares(hidden_once, (5.9, 6.6)) == (0.0, 0.0, 0.0)
    through = [np.concatenate((car, wall)), hidden[1], np.concatenate((car, wall))]
    assert min(shares(through, (5.9, 6.6))) > 0.5


def test_without_returns_pixels_are_missing_but_have_not_changed():
    alone = [screen(5.0, 0.5), np.concatenate((block(6.0, 4.0), screen(5.0, 0.5))), screen(5.0, 0.5)]
    assert shares(alone, (5.9, 6.6)) == (1.0, 0.0, 1.0)


def test_nothing_has_changed_in_a_pair_or_in_an_empty_window():
    empty = Window(*[Sweep(np.zeros((0, 3), np.float32))] * 2, (Sweep(np.full((3, 3), np.nan)),))
    windows = [scene(3), empty, scene(4, num_history=1)]
    sweeps = sweeps_of(windows, SETTINGS)
    for values in find_changed(sweeps):
        assert not values[sweeps.pixels.window == 0].any() and values.any()
    assert not any(values.any() for values in find_changed(sweeps_of(windows[:1], SETTINGS)))


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
    return ChangedPixels(every, ~every, every)


def test_a_pedestrian_next_to_a_wall_moves_and_the_wall_is_static(monkeypatch):
    window, is_walker = beside_a_wall(0.13, 20.0)
    flow = VerifiedFlow(MODEL)([window])[0].residual_flow.numpy()
    moves = flow.any(1)
    assert moves[is_walker].mean() > 0.95 and np.abs(np.median(flow[is_walker], 0) - (0.13, 0.0, 0.0)).max() < 0.05
    assert moves[~is_walker].mean() < 0.02
    with monkeypatch.context() as patch:  # without the pixels that did not change
        patch.setattr(VerifiedFlow, "add_unchanged", staticmethod(lambda sweeps, tree, motion: tree))
        assert 0.6 < VerifiedFlow(MODEL)([window])[0].residual_flow.any(1)[is_walker].double().mean() < 0.8
    monkeypatch.setattr(VerifiedFlow, "find_changed", staticmethod(nothing))
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
    monkeypatch.setattr(motion_margin, "_LEAST_LIKELY", 4 * (0.0,))  # also those that are hardly ever right
    assert model([window])[0].residual_flow.any()
