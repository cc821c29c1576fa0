"""Local motion: the oracle's groups on random scenes; walkers beside walls move, walls do not."""

from __future__ import annotations

from typing import Dict, Sequence

import numpy as np
import torch
from moving_scenes import for_oracle
from oracle import local_motion as oracle
from oracle.height_slices import Pixel
from scenes import pose, sweeps_of

from cflow_torch import Sweep, Window
from cflow_torch.config import VerifiedConfig
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
    images = [window * batch.num_steps + step for step in steps]
    clouds = [batch.positions[:, (batch.image == image) & batch.takes_part].T.numpy() for image in images]
    origins = [batch.origin[window, step].tolist() for step in steps]
    object_of, motions = by_pixel(objects, motion, sweeps, window)
    return oracle.find_local_motion(before, object_of, motions, clouds, clouds, origins, settings)


def as_oracle(windows: Sequence[Window], settings: VerifiedConfig, seed: int = 0) -> int:
    """How many groups are found; objects and motions are the oracle's."""
    given = asked(windows, settings, seed)
    found = find_local_motion(*given)
    for window in range(len(windows)):
        own = by_pixel(found[0], found[1], given[3], window)
        assert own == expected(given[0], given[1], given[3], window, settings)
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
