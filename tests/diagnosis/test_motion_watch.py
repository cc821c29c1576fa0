"""Pairs of a log in which far more points move than in the pair before are told if the static structure agrees."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from cflow_torch.data.log import Log, window
from cflow_torch.diagnosis.inspection import MotionWatch
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import relative_transform
from cflow_torch.types import Window


@pytest.fixture(scope="module")
def drive() -> Log:
    return make_drive(seed=2, num_sweeps=6, profile="demo", scene="street")


def told(watch: MotionWatch, pair: Window, share: float, count: int = 1000) -> str:
    """What the watch says if this share of `count` points moves, and the ego motion is that of the poses."""
    flow = torch.zeros(count, 3)
    flow[: round(share * count), 0] = 0.5
    T_ego1_ego0 = relative_transform(pair.pc1.pose, pair.pc0.pose)
    pose_flow = torch.from_numpy(ego_motion_flow(pair.pc0.points, T_ego1_ego0)).float()
    is_valid = torch.ones(count, dtype=torch.bool)
    result: Any = SimpleNamespace(residual_flow=flow, is_valid=is_valid, pose_flow=pose_flow)
    return watch(pair, result)


def interchanged(log: Log) -> Window:
    """The pair (3, 4) with the points of sweep 5 in place of those of sweep 4."""
    good = window(log, 3, 1)
    pc1 = type(good.pc1)(log.sweep(5).points, log.sweep(5).is_ground, good.pc1.pose, good.pc1.timestamp_ns)
    return Window(good.pc0, pc1, good.pch)


def test_a_sweep_of_another_time_is_told(drive: Log) -> None:
    watch = MotionWatch()
    assert told(watch, window(drive, 2, 1), 0.2) == ""
    assert "60% of the points move, 20% in the pair before" in told(watch, interchanged(drive), 0.6)
    assert told(watch, window(drive, 3, 1), 0.2) == "", "a wrong pair does not change what is usual"


@pytest.mark.parametrize(("share", "count"), [(0.25, 1000), (0.6, 300)])
def test_a_small_change_and_few_points_are_no_suspicion(drive: Log, share: float, count: int) -> None:
    watch = MotionWatch()
    told(watch, window(drive, 2, 1), 0.2)
    assert told(watch, interchanged(drive), share, count) == ""


def test_structure_that_stays_in_place_and_a_first_pair_are_not_told(drive: Log) -> None:
    watch = MotionWatch()
    assert told(watch, interchanged(drive), 0.9) == ""
    told(watch, window(drive, 2, 1), 0.2)
    assert told(watch, window(drive, 3, 1), 0.9) == "", "the structure fits, so others begin to move"
