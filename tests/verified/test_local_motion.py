"""Local motion: the oracle's groups on random scenes; walkers beside walls move, walls do not."""

from __future__ import annotations

from typing import Dict, Sequence, Tuple

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle
from oracle import local_motion as oracle
from oracle.height_slices import Pixel
from scenes import pose, sweeps_of

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified import method, visibility
from cflow_torch.verified.component_tree import Objects, find_components, select_objects
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.local_motion import find_local_motion
from cflow_torch.verified.paired_test import VerifiedLevel

REGION = (-6.0, -5.0, -2.0, 6.0, 5.0, 4.0)


def settings_of(pixel_size: float = 0.1) -> VerifiedConfig:
    return VerifiedConfig(pixel_sizes=(pixel_size,), point_cloud_range=REGION, num_history=4, num_future=2)


def walkers(seed: int, num_history: int = 3, num_future: int = 0, num_walkers: int = 4) -> Window:
    """Columns that walk before a wall, behind a fence and a post that cast shadows; the sensor drives; NaN rows."""
    rng = np.random.default_rng(seed)
    places, velocities = rng.uniform((-5, -4), (5, 4), (num_walkers, 2)), rng.normal(0, 0.15, (num_walkers, 2))
    speed, yaw = rng.uniform(0, 0.4), rng.normal(0, 0.01)
    sweeps = []
    for k in [*range(num_history + 2), *range(-1, -1 - num_future, -1)]:  # t+1, t, t-1, ..., then t+2, ...
        parts = []
        for place, velocity in zip(places, velocities):
            column = rng.uniform((-0.25, -0.25, -1.4), (0.25, 0.25, 0.4), (120, 3))
            parts.append(column + [*(place - k * velocity), 0.0])
        parts.append(np.stack((rng.uniform(-6, 6, 300), np.full(300, 4.3), rng.uniform(-1.5, 3, 300)), 1))
        parts.append(np.stack((rng.uniform(0.5, 2.5, 150), np.full(150, 1.5), rng.uniform(-1.5, 1, 150)), 1))
        T_world_ego = pose(-k * speed, 0.0, -k * yaw)
        points = (np.concatenate(parts) + rng.normal(0, 0.01, (num_walkers * 120 + 450, 3))) - T_world_ego[:3, 3]
        points = points @ T_world_ego[:3, :3]
        points[:3] = np.nan
        sweeps.append(Sweep(points.astype(np.float32), pose=T_world_ego))
    last = num_history + 2
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:last]), tuple(sweeps[last:]))


def asked(windows: Sequence[Window], settings: VerifiedConfig, seed: int = 0):
    """Objects of some windows, some of which move, as `find_local_motion` takes them."""
    sweeps = sweeps_of(list(windows), settings)
    level = find_components(sweeps, 1, True, settings)
    zeros = torch.zeros(level.num_components, dtype=torch.int64)
    objects = select_objects([level], [zeros])
    # What an object does depends on its first pixel only, so that it is the same in every batch.
    first = sweeps.pixel[objects.first] % (sweeps.grid.height * sweeps.grid.width)
    motion = torch.stack((first % 5 - 2.0, first % 3 - 1.0), 1).double() * ((first + seed) % 4 == 0)[:, None]
    return objects, motion, [VerifiedLevel(level, motion, zeros, torch.zeros(0))], sweeps


def by_pixel(objects: Objects, motion: torch.Tensor, sweeps: HeightSlicedSweeps, window: int):
    """Object of each pixel of a window, numbered from 0, and motions, as the oracle gives them."""
    mine = sweeps.window == window
    of_pixel = objects.of_pixel[mine].tolist()
    numbers = {own: i for i, own in enumerate(dict.fromkeys(own for own in of_pixel if own < objects.count))}
    pixels = zip(*(values[mine].tolist() for values in (sweeps.step, sweeps.row, sweeps.col)))
    elapsed = sweeps.elapsed[window].tolist()
    kept = [step for step, k in enumerate(elapsed) if step == 0 or k != 0]
    object_of: Dict[Pixel, int] = {
        (kept.index(m), r, c): numbers[own] for (m, r, c), own in zip(pixels, of_pixel) if own in numbers
    }
    return object_of, [tuple(motion[own].tolist()) for own in numbers]


def expected(objects: Objects, motion: torch.Tensor, sweeps: HeightSlicedSweeps, window: int, settings):
    batch, before = sweeps.batch, for_oracle(sweeps, window)
    steps = [step for step, k in enumerate(sweeps.elapsed[window].tolist()) if step == 0 or k != 0]
    rows = [(batch.image == window * batch.num_steps + step) & batch.takes_part for step in steps]
    clouds = [batch.positions[:, row].T.numpy() for row in rows]
    origins = [batch.origin[window, step].tolist() for step in steps]
    object_of, motions = by_pixel(objects, motion, sweeps, window)
    return oracle.find_local_motion(before, object_of, motions, clouds, clouds, origins, settings)


def as_oracle(windows: Sequence[Window], settings: VerifiedConfig, seed: int = 0) -> int:
    """How many groups are found; objects and motions are the oracle's."""
    given = asked(windows, settings, seed)
    found = find_local_motion(*given)
    for window in range(len(windows)):
        *own, doubt = expected(given[0], given[1], given[3], window, settings)
        assert list(by_pixel(found[0], found[1], given[3], window)) == own
        of_pixel = found[2][given[3].window == window]
        assert np.allclose(of_pixel, [doubt.get(pixel, 0.0) for pixel in for_oracle(given[3], window).pixels()])
    small = given[3].grid.pixel_size
    new = found[0].component >= given[2][0].level.num_components
    assert (found[1][new].norm(dim=1) * small < 0.25).all() and found[1][new].any(1).all()
    return int(new.sum())


def test_groups_equal_the_oracle():
    moved = 0
    for seed in range(6):
        windows = [walkers(10 * seed + i, (3, 0, 1, 2)[(seed + i) % 4], (0, 2)[seed % 2]) for i in range(1 + seed % 3)]
        moved += as_oracle(windows, settings_of((0.1, 0.25)[seed % 3 == 2]), seed)
    assert moved > 5


def crossing(rng: np.random.Generator) -> Window:
    """A cloud that crosses another one, which stands, both beyond all borders of small images."""
    low, high = (-1.6, -1.6, -1.0), (1.6, 1.6, 1.0)
    moving, velocity = rng.uniform(low, high, (400, 3)), rng.choice([0.1, 0.15, 0.2], 2) * rng.choice([-1, 1], 2)
    standing, sweeps = rng.uniform(low, high, (400, 3)), []
    for k in range(5):
        points = (moving[rng.random(400) < 0.8] - k * np.append(velocity, 0), standing[rng.random(400) < 0.5])
        sweeps.append(Sweep(np.concatenate(points).astype(np.float32)))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def test_the_last_place_of_a_row_is_not_beside_the_first_of_the_next():
    settings = settings_of().replace(point_cloud_range=(-1.35, -1.35, -2.0, 1.35, 1.35, 4.0))
    for seed in (2, 30):  # it would change these two
        rng = np.random.default_rng(seed)
        assert as_oracle([crossing(rng), crossing(rng)], settings, seed) > 0


def test_pairs_and_empty_windows_are_left_alone():
    empty = Sweep(np.zeros((0, 3), np.float32))
    for windows in ([walkers(1, 0)], [Window(empty, empty)], [Window(empty, empty, (empty,))]):
        given = asked(windows, settings_of())
        objects, motion, doubt = find_local_motion(*given)
        assert objects is given[0] and motion is given[1] and not doubt.any()
    # Beside others as well; sweeps of one point.
    one = Sweep(np.array([[0.5, 0.5, 0.0]], np.float32))
    assert as_oracle([walkers(1, 0), Window(empty, empty), walkers(1), Window(one, empty, (empty, one))], settings_of())


# ----------------------------------------------------------------------------------------- what it is for


def column(slices: int, velocity: Sequence[float], sensor: Sequence[float] = (0.0, 0.0)) -> int:
    """Groups that are found in a thing, so many slices high, that crosses a larger one which stands, as the oracle
    finds them, if the sensor drives."""
    rng = np.random.default_rng(3)
    thing = rng.uniform((0.0, 0.0, -1.5), (0.5, 0.5, 0.5 * slices - 1.5), (250, 3))
    wall, sweeps = rng.uniform((-2.0, 0.7, -1.5), (2.0, 1.0, 0.5), (900, 3)), []
    for k in range(5):
        T_world_ego = pose(-k * sensor[0], -k * sensor[1], 0.0)
        points = np.concatenate((thing - [*(k * np.array(velocity)), 0.0], wall)) - T_world_ego[:3, 3]
        sweeps.append(Sweep(points.astype(np.float32), pose=T_world_ego))
    objects, motion, levels, images = asked([Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))], settings_of())
    found = find_local_motion(objects, torch.zeros_like(motion), levels, images)
    *truth, _ = expected(objects, torch.zeros_like(motion), images, 0, settings_of())
    assert list(by_pixel(found[0], found[1], images, 0)) == truth
    return int(found[1].any(1).sum())


def test_what_is_believed():
    assert column(4, (0.2, 0.0)) > 0 and column(3, (0.1, -0.1)) > 0
    assert column(2, (0.2, 0.0)) == 0  # flat
    assert column(4, (0.2, 0.0), (0.2, 0.0)) == 0  # it moves as the sensor does
    assert column(4, (0.2, 0.0), (-0.2, 0.1)) > 0
    assert column(4, (0.3, 0.0)) == 0  # too fast


def beside_a_wall(speed: float, density: float) -> Tuple[Window, np.ndarray]:
    """A walker 0.2 m before a wall of so many points a square metre, five sweeps, the sensor drives; which points of t
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


MODEL = make_config("default", point_cloud_range=(-10.0, -10.0, -3.0, 10.0, 10.0, 8.0))


def test_a_walker_beside_a_wall_moves_and_the_wall_stands(monkeypatch):
    window, is_walker = beside_a_wall(0.13, 20.0)
    flow = VerifiedFlow(MODEL)([window])[0].residual_flow.numpy()
    assert np.abs(flow[is_walker].mean(0) - (0.13, 0.0, 0.0)).max() < 0.03
    assert not flow[~is_walker].any()
    nothing = lambda objects, motion, _, sweeps: (objects, motion, 0.0 * sweeps.row)  # noqa: E731
    monkeypatch.setattr(method, "find_local_motion", nothing)
    assert not VerifiedFlow(MODEL)([window])[0].residual_flow.any()


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


@pytest.mark.parametrize("speed", [0.15, 0.18])
def test_shadows_of_a_parked_car_do_not_move_the_wall(speed, monkeypatch):
    model, window = VerifiedFlow(MODEL), shadowed(0, speed)
    assert not model([window])[0].residual_flow.any()
    monkeypatch.setattr(visibility, "_NEARER", 1e9)  # nothing is hidden
    assert model([window])[0].residual_flow.any(1).double().mean() > 0.03
