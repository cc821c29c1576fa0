"""Ground residue: the oracle's pixels on random scenes; sums of heights."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracle.ground_residue import ground_heights, is_residue
from oracle.sweeps import compensate, ground_points
from scenes import RANGE, config, same_bits, sweeps_of

from cflow_torch import Sweep, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ground_heights import GroundHeights

SIZE = 0.25
SETTINGS = config("verified", min_height=0.4, num_history=1)
LOW, HIGH = np.array(RANGE[:3]), np.array(RANGE[3:])


def random_window(seed: int) -> Window:
    """Sloped ground with a mask, remnants of it without, some posts; every third has no masks."""
    rng = np.random.default_rng(seed)
    slope, sweeps = rng.normal(0, 0.05, 2), []

    def on_ground(count: int, noise: float) -> np.ndarray:
        xy = rng.uniform(LOW[:2] - 1, HIGH[:2] + 1, (count, 2))
        return np.column_stack([xy, xy @ slope - 1 + rng.normal(0, noise, count)])

    for _ in range(3):
        ground, remnants = on_ground(int(rng.integers(0, 150)), 0.05), on_ground(int(rng.integers(0, 120)), 0.3)
        ground[:3] = np.array([[np.nan], [np.inf], [-np.inf]])[: len(ground)]
        posts = on_ground(int(rng.integers(1, 12)), 0.1).repeat(6, 0)
        posts += rng.uniform(-0.3, 0.3, posts.shape) + [0, 0, 0.4]
        mask = np.repeat([True, False], [len(ground), len(remnants) + len(posts)])
        sweeps.append(Sweep(np.concatenate([ground, remnants, posts]), None if seed % 3 == 2 else mask))
    return Window(sweeps[0], sweeps[1], (sweeps[2],))


def kept(windows: list) -> list:
    """Of each window and step, which points of t+1, t, t-1 that take part are on a pixel."""
    sweeps = sweeps_of(windows, SETTINGS)
    batch, nowhere = sweeps.batch, sweeps.image.numel() - 1
    images = torch.arange(batch.num_windows * batch.num_steps).view(batch.num_windows, -1).tolist()
    return [
        [(sweeps.place[(batch.image == image) & batch.takes_part] != nowhere).tolist() for image in of_window]
        for of_window in images
    ]


@pytest.mark.parametrize("seed", range(4))
def test_pixels_equal_the_oracle_in_a_batch(seed):
    windows, dropped = [random_window(4 * seed + i) for i in range(4)], 0
    for window, found in zip(windows, kept(windows)):
        clouds, cloud1 = compensate(window, SETTINGS)
        means = ground_heights([ground_points(window.pc0, clouds[0]), ground_points(window.pc1, cloud1)], SETTINGS)
        for cloud, mine in zip((cloud1, *clouds), found):
            inside = cloud.takes_part & ((cloud.points >= LOW) & (cloud.points <= HIGH)).all(1)
            expected = ~is_residue(cloud.points[inside], means, 0.4, SETTINGS)
            assert mine == expected.tolist()
            dropped += int((~expected).sum())
    assert dropped > 20


def test_heights_do_not_depend_on_the_order_of_points_nor_overflow():
    rng, grid = np.random.default_rng(5), Grid(SIZE, RANGE[:3], RANGE[3:])
    points = torch.from_numpy(rng.uniform(RANGE[:3], RANGE[3:], (400, 3)).T.copy())
    sums = [GroundHeights(1, grid, torch.device("cpu")) for _ in range(3)]
    sums[0].add(0, points)
    for part in points[:, torch.from_numpy(rng.permutation(400))].split(70, 1):
        sums[1].add(0, part)
    assert same_bits(sums[0].mean(), sums[1].mean())
    sums[2].add(0, torch.tensor([[1.0] * 6, [2.0] * 6, [1e300] * 6], dtype=torch.float64))
    assert sums[2].mean().max() == 10**10


def test_ground_counts_of_the_newest_pair_only():
    one, other = random_window(0), random_window(1)
    heights = sweeps_of([one, other], SETTINGS).batch.ground
    pairs = [Window(window.pc0, window.pc1) for window in (one, other)]
    assert same_bits(heights.mean(), sweeps_of(pairs, SETTINGS).batch.ground.mean())
    assert sweeps_of([one], config("verified", min_height=None, num_history=1)).batch.ground is None
