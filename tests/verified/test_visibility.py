"""Visibility: the oracle's answers on random returns; what is behind something is hidden, what is beside it is not."""

from __future__ import annotations

from typing import List, Sequence

import numpy as np
import torch
from oracle import visibility as oracle
from scenes import pose, scene, sweeps_of

from cflow_torch import Sweep, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified.visibility import RangeImages

REGION = (-20.0, -20.0, -3.0, 20.0, 20.0, 5.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION, num_history=3, num_future=2, min_height=None)
_rng = np.random.default_rng(0)
_GRID = np.stack(np.meshgrid(np.arange(-7.95, 8, 1.0), np.arange(-6.95, 7, 1.0), (-1.75, -0.25, 1.25)), -1)
PLACES = np.concatenate((_rng.uniform((-25, -25, -9), (25, 25, 9), (300, 3)), _GRID.reshape(-1, 3)))


def asked(windows: Sequence[Window], places: np.ndarray = PLACES) -> torch.Tensor:
    """(B, S, K) bool: which places are hidden in which sweep."""
    sweeps = sweeps_of(list(windows), SETTINGS)
    images, (num_windows, num_steps) = RangeImages(sweeps), sweeps.elapsed.shape
    hidden = torch.zeros((num_windows, num_steps, len(places)), dtype=torch.bool)
    for window in range(num_windows):
        for step in range(num_steps):
            where = [torch.full((len(places),), at) for at in (window, step)]
            hidden[window, step] = images.hide(*where, *torch.from_numpy(places).T)
    return hidden


def expected(windows: Sequence[Window]) -> List[List[List[bool]]]:
    batch = sweeps_of(list(windows), SETTINGS).batch
    result = []
    for window in range(len(windows)):
        rows = [(batch.image == window * batch.num_steps + step) & batch.takes_part for step in range(batch.num_steps)]
        clouds = [batch.positions[:, row].T.numpy() for row in rows]
        height = oracle.sensor_height(clouds[0])
        images = [oracle.RangeImage(*of, height) for of in zip(clouds, batch.origin[window].tolist())]
        result.append([[image.hides(place) for place in PLACES.tolist()] for image in images])
    return result


def test_answers_equal_the_oracle():
    for seed in range(4):
        windows = [
            scene(70 + 5 * seed + i, num_history=(seed + i) % 3, num_future=2 * (i == 1), poses=seed % 4 > 0)
            for i in range(1 + seed % 3)
        ]
        hidden = asked(windows)
        assert hidden.tolist() == expected(windows)
        assert 0.02 < hidden.float().mean() < 0.3


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
    return asked([Window(pc0, pc1)], np.array(places))[0].tolist()


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
