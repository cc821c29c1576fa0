"""Where sweeps measured: plain loops, a sensor that sees a part of its surroundings only, and lost packets."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cflow_torch import VerifiedFlow
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import make_drive
from cflow_torch.types import Sweep, Window
from cflow_torch.windows.coverage import Coverage

NUM_BINS = 180
SHORTEST = 16


def bin_of(x: float, y: float) -> int:
    """Of the vector; the circle has length 4, and y / (|x| + |y|) measures a quarter."""
    around = y / (abs(x) + abs(y))
    around = around + 1 if x >= 0 else 3 - around
    return min(int(around * NUM_BINS / 4), NUM_BINS - 1)


def unmeasured_by_loops(points: np.ndarray) -> list[bool]:
    """Of the points of a sweep, (N, 2), which have ground among them."""
    is_empty = [True] * NUM_BINS
    for x, y in points.tolist():
        is_empty[bin_of(x, y)] = False
    result = [False] * NUM_BINS
    for start in range(NUM_BINS):
        run = [(start + i) % NUM_BINS for i in range(SHORTEST)]
        if all(is_empty[i] for i in run):
            for i in run:
                result[i] = True
    return result


def test_equals_plain_loops_for_sweeps_alone_and_together():
    rng = np.random.default_rng(0)
    sweeps = []
    for low, high in ((-0.6, 0.6), (-3.1, 2.9), (2.8, 3.5), (-2.0, 2.3)):
        angle = rng.uniform(low, high, 300)
        sweeps.append(rng.uniform(2, 50, (300, 1)) * np.stack((np.cos(angle), np.sin(angle)), 1))
    offsets = [torch.from_numpy(points).float().double().t() for points in sweeps]
    is_ground = torch.arange(300) < 5
    alone, together = (Coverage(2, 2, torch.device("cpu")) for _ in range(2))
    for image, offset in enumerate(offsets):
        alone.add(image, offset, is_ground & (image != 3))  # the last sweep has no ground
    image = torch.arange(4, dtype=torch.int32).repeat_interleave(300)
    together.add(image, torch.cat(offsets, 1), is_ground.repeat(4) & (image != 3))
    expected = [unmeasured_by_loops(offset.t().numpy()) for offset in offsets[:3]] + [[False] * NUM_BINS]
    assert alone.unmeasured().view(4, -1).tolist() == expected
    assert torch.equal(together.unmeasured(), alone.unmeasured())
    assert [sum(flags) for flags in expected][0] > 100 and sum(expected[1]) == 0 and sum(expected[2]) > 100


def cut(sweep: Sweep, is_front: bool, is_lost: bool) -> np.ndarray:
    """The points, (N,) bool, of a view of 70 degrees to the front, or what is left if a quarter is lost."""
    azimuth = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
    return np.abs(azimuth) < 35 if is_front else ~(is_lost & (azimuth > 0) & (azimuth < 90))


@pytest.mark.parametrize(("is_front", "pair"), [(True, 7), (False, 11)])
def test_static_points_stay_static_where_sweeps_are_cut(is_front, pair):
    drive = make_drive(seed=1, num_sweeps=pair + 2, profile="demo", scene="street")
    sweeps = []
    for index in range(pair + 1, pair - 5, -1):
        sweep = drive.sweep(index)
        kept = cut(sweep, is_front, index % 3 == 0)
        sweeps.append(Sweep(sweep.points[kept], is_ground=sweep.is_ground[kept], pose=sweep.pose))
    newest, now, *history = sweeps
    (result,) = VerifiedFlow.from_preset("default")([Window(now, newest, pch=tuple(history))])
    sweep = drive.sweep(pair)
    truth = drive.labels(pair).flow - ego_motion_flow(sweep.points, np.linalg.inv(newest.pose) @ now.pose)
    speed = np.linalg.norm(truth, axis=1)[cut(sweep, is_front, pair % 3 == 0)]
    moves = result.is_moving.numpy()
    assert (moves & (speed < 0.001)).sum() < 60
    assert moves[speed > 0.3].mean() > 0.7  # of the others, t+1 has lost the points
