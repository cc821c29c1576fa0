"""Relinking: the oracle's things on random scenes; fast things of few points move, what comes and goes does not."""

from __future__ import annotations

from typing import List, Sequence, Tuple

import numpy as np
import torch
from moving_scenes import for_oracle
from oracle.relinking import relink as expected
from scenes import pose, sweeps_of

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified.component_tree import find_components, select_objects
from cflow_torch.verified.relinking import relink

REGION = (-16.0, -10.0, -2.0, 16.0, 10.0, 4.0)


def settings_of(pixel_size: float = 0.1, **others) -> VerifiedConfig:
    return VerifiedConfig(pixel_sizes=(pixel_size,), point_cloud_range=REGION, num_history=4, **others)


def traffic(seed: int, num_history: int = 3, num_things: int = 6) -> Window:
    """Small boxes, and one of about 12 m, that jump by metres, seen by few or many points or not at all; a sensor that
    drives; NaN rows."""
    rng = np.random.default_rng(seed)
    places, velocities = rng.uniform((-8, -8), (8, 8), (num_things, 2)), rng.normal(0, 2.0, (num_things, 2))
    sizes = rng.uniform((0.2, 0.5, 0.3), (0.8, 2.0, 1.8), (num_things, 3))
    places[0], velocities[0], sizes[0, 0] = 0.0, (0.5, 3.0), rng.choice((11.6, 12.4))
    sweeps = []
    for k in range(num_history + 2):  # t+1, t, t-1, ...
        parts = [np.full((3, 3), np.nan), rng.uniform((-15, 9, -1), (15, 9.2, 1), (60, 3))]
        for place, velocity, size in zip(places, velocities, sizes):
            number = rng.choice((0, 12, 25, 80), p=(0.1, 0.2, 0.3, 0.4)) * (1 + (size[0] > 2))
            parts.append(rng.uniform(-0.5, 0.5, (number, 3)) * size + [*(place - k * velocity), 0.0])
        T_world_ego = pose(-0.3 * k, 0.0, 0.01 * k)
        points = (np.concatenate(parts) - T_world_ego[:3, 3]) @ T_world_ego[:3, :3]
        sweeps.append(Sweep(points.astype(np.float32), pose=T_world_ego))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def as_oracle(windows: Sequence[Window], settings: VerifiedConfig) -> int:
    """How many things are found; objects and motions are the oracle's."""
    sweeps = sweeps_of(list(windows), settings)
    level = find_components(sweeps, 1, True, settings)
    objects = select_objects([level], [torch.zeros(level.num_components, dtype=torch.int64)])
    motion = (objects.first % 3)[:, None] * torch.tensor([[1.0, -0.5]], dtype=torch.float64)
    found, motions = relink(objects, motion, sweeps, settings)
    for window in range(len(windows)):
        mine = sweeps.window == window
        pixels = for_oracle(sweeps, window).pixels()
        before, after = (dict(zip(pixels, of.of_pixel[mine].tolist())) for of in (objects, found))
        given = {pixel: own for pixel, own in before.items() if own < objects.count}
        names = list(dict.fromkeys(given.values()))
        object_of, of_object = expected(
            for_oracle(sweeps, window),
            {pixel: names.index(own) for pixel, own in given.items()},
            [tuple(motion[own].tolist()) for own in names],
            settings,
        )
        after = {pixel: own for pixel, own in after.items() if own < found.count}
        names = list(dict.fromkeys(after.values()))
        assert {pixel: names.index(own) for pixel, own in after.items()} == object_of
        assert [tuple(motions[own].tolist()) for own in names] == of_object
    return found.count - objects.count


def test_things_equal_the_oracle():
    num_found = 0
    for seed in range(10):
        windows = [traffic(10 * seed + i, (3, 4, 1, 2, 0)[(seed + i) % 5]) for i in range(1 + seed % 3)]
        num_found += as_oracle(windows, settings_of((0.1, 0.25)[seed % 2], max_speed=(60.0, 20.0)[seed % 3 == 2]))
    assert num_found > 10


def test_pairs_and_empty_windows_are_left_alone():
    empty = Sweep(np.zeros((0, 3), np.float32))
    for windows in ([traffic(1, 0)], [Window(empty, empty)], [Window(empty, empty, (empty,))]):
        assert as_oracle(windows, settings_of()) == 0
    assert as_oracle([traffic(1, 0), Window(empty, empty), traffic(3)], settings_of()) > 0


def rears(way: float, seen: Sequence[bool] = (True, True, True, True), num_points: int = 60) -> List[Sweep]:
    """A plate as wide as a car that goes so many metres along x between sweeps, seen in some of them, t+1 first."""
    rng = np.random.default_rng(0)
    plate = rng.uniform((-0.15, -0.9, -1.0), (0.15, 0.9, 0.5), (num_points, 3))
    noise = [rng.normal(0, 0.01, plate.shape) for _ in seen]
    sweeps = [plate + noise[k] - [k * way - 4.0, 0.0, 0.0] for k in range(len(seen))]
    return [Sweep(of[: num_points * is_seen].astype(np.float32)) for of, is_seen in zip(sweeps, seen)]


def flow_of(sweeps: Sequence[Sweep]) -> Tuple[float, float]:
    """Median flow of t along x and y."""
    model = VerifiedFlow(settings_of().replace(pixel_sizes=(0.4, 0.2, 0.1), max_speed=60.0, min_height=None))
    (result,) = model([Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))])
    x, y, _ = result.residual_flow.median(0).values.tolist()
    return x, y


def test_a_fast_rear_moves_if_other_sweeps_show_it_again():
    x, y = flow_of(rears(3.0))
    assert abs(x - 3.0) < 0.05 and abs(y) < 0.05
    assert abs(flow_of(rears(3.0, (True, True, False, True)))[0] - 3.0) < 0.05  # hidden at t-1
    assert flow_of(rears(3.0, (False, True, True, True))) == (0.0, 0.0)  # t+1 does not show it
    assert flow_of(rears(3.0, (True, True, False, False))) == (0.0, 0.0)  # once may be chance
    assert flow_of(rears(7.0)) == (0.0, 0.0)  # faster than max_speed
    assert flow_of(rears(3.0, num_points=3)) == (0.0, 0.0)
