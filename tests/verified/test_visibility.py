"""Visibility: what is behind something is hidden, what is beside it is not."""

from __future__ import annotations

from typing import List, Sequence

import numpy as np
import torch
from scenes import pose, sweeps_of

from cflow_torch import Sweep, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified.visibility import RangeImages

REGION = (-20.0, -20.0, -3.0, 20.0, 20.0, 5.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION, num_history=3, num_future=2, min_height=None)


def screen(distance: float, at: Sequence[float] = (0.0, 0.0)) -> np.ndarray:
    """4 m wide and 2 m high, dense, so far before a sensor that stands 1.6 m over the ground, which is at z = -2."""
    y, z = np.meshgrid(np.arange(-2, 2, 0.02), np.arange(-2, 0, 0.05))
    return np.stack((np.full(y.size, distance), y.ravel(), z.ravel()), 1) + [*at, 0.0]


def hides(newest: np.ndarray, older: np.ndarray, places: Sequence[Sequence[float]], way: float) -> List[List[bool]]:
    """Of t+1 and of t, when the sensor was `way` metres further left, 10 m of ground beside them."""
    ground = np.stack((np.linspace(-10, -5, 500), np.zeros(500), np.full(500, -2.0)), 1)
    T_world_ego = pose(0.0, way, 0.0)
    clouds = [np.concatenate((cloud, ground)) for cloud in (newest, older)]
    pc1, pc0 = Sweep(clouds[0], pose=np.eye(4)), Sweep(clouds[1] - T_world_ego[:3, 3], pose=T_world_ego)
    images, first = RangeImages(sweeps_of([Window(pc0, pc1)], SETTINGS)), torch.zeros(len(places), dtype=torch.int64)
    columns = torch.tensor(places, dtype=torch.float64).unbind(1)
    return [images.hide(first, first + step, *columns).tolist() for step in (0, 1)]


def test_what_is_behind_a_screen_is_hidden():
    places = [(10, 0, -1), (10, 3.5, -1), (10, 4.5, -1), (10, 0, 0.3), (10, 0, 1.0)]
    places += [(4, 0, -1), (5.4, 0, -1), (5.7, 0, -1)]
    # Behind it; behind its side; beside it; behind its top, which rises from the sensor; above that; before it; nearer
    # than half a metre behind it; beyond that.
    truth = [True, True, False, True, False, False, False, True]
    assert hides(screen(5.0), screen(5.0), places, 0.0) == [truth] * 2


def test_shadows_are_cast_from_where_the_sensor_was():
    # From 3 m further left the screen hides what is further right.
    left, right = (10.0, 3.5, -1.0), (10.0, -6.0, -1.0)
    assert hides(screen(5.0), screen(5.0), [left, right], 3.0) == [[True, False], [False, True]]
