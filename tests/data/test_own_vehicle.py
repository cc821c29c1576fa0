"""Returns of the own vehicle ride along with it: they are left out, and nothing else is."""

from __future__ import annotations

import warnings
from functools import lru_cache

import numpy as np
import pytest

from cflow_torch.data.arrays import write_array_log
from cflow_torch.data.catalog import open_log
from cflow_torch.data.log import CachedLog, FlowLabels, Log
from cflow_torch.data.log_check import FOUND, RIGHT, examine
from cflow_torch.data.own_vehicle import OwnVehicleLog
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import transform_points
from cflow_torch.types import CFlowError, CFlowWarning, Sweep


@lru_cache(maxsize=None)
def drive_of(num_sweeps):
    return CachedLog(make_drive(seed=1, num_sweeps=num_sweeps, profile="demo"), num_sweeps)


class Added(Log):
    """A drive with more points in the frame of each sweep. `points` is called with the index and the pose."""

    def __init__(self, points, num_sweeps=16, drive=None, poses=True):
        self.drive = drive or drive_of(num_sweeps)
        self.log_id, self.timestamps, self.points = "ride", self.drive.timestamps, points
        self.poses = self.drive.poses if poses else None

    def sweep(self, index):
        sweep = self.drive.sweep(index)
        more = self.points(index, sweep.pose).astype(np.float32)
        mask = np.append(sweep.is_ground, np.zeros(len(more), bool))
        return Sweep(np.concatenate([sweep.points, more]), mask, sweep.pose, sweep.timestamp_ns)

    def _labels(self, index):
        more = len(self.sweep(index).points) - len(self.drive.sweep(index).points)
        labels = self.drive.labels(index)
        flow, category, valid = (
            np.concatenate([values, np.ones((more, *values.shape[1:]), values.dtype)])
            for values in (labels.flow, labels.category, labels.is_valid)
        )
        return FlowLabels(flow, category, valid)


@pytest.fixture
def hood():
    """40 returns of the hood and a mirror, which the LiDAR measures with 1 cm of noise."""
    rng = np.random.default_rng(0)
    fixed = np.concatenate([rng.uniform([1.5, -0.8, 0.5], [2.4, 0.8, 0.9], (30, 3)), rng.normal(0, 0.05, (10, 3))])
    fixed[30:] += (0.8, 1.1, 1)
    return lambda index, _: fixed + np.random.default_rng(index).normal(0, 0.01, fixed.shape)


def num_left_out(log):
    return [int(np.isnan(log.sweep(index).points).any(1).sum()) for index in range(len(log))]


def test_returns_that_ride_along_are_left_out_and_said(hood):
    given = Added(hood)
    log = OwnVehicleLog(given)
    with pytest.warns(CFlowWarning, match="40 returns within 2.7 m ride along .* data.own_vehicle=null keeps them"):
        assert num_left_out(log) == [40] * 16
    assert np.array_equal(log.sweep(3).points[:-40], given.sweep(3).points[:-40])
    assert OwnVehicleLog(given).labels(3).is_valid[-40:].sum() == 0 and given.labels(3).is_valid[-40:].all()
    own = next(one for one in examine(log) if one.topic == "own vehicle")
    assert own.status == FOUND and "leave them out" in own.text


def test_a_wall_along_the_road_a_standing_vehicle_and_unknown_poses_stay(hood):
    straight = make_drive(seed=1, num_sweeps=10, profile="demo", scene="highway")
    start = straight.poses[0]
    grid = np.stack(np.meshgrid(np.arange(-40, 60, 0.08), [2.2, 2.25], np.arange(0.3, 2, 0.2)), -1).reshape(-1, 3)

    def wall(_, pose):
        """A wall that is fixed in the world, 2.2 m beside the path, seen between -20 and 20 m."""
        seen = transform_points(grid, np.linalg.inv(pose) @ start)
        return seen[np.abs(seen[:, 0]) < 20]

    for log in (
        Added(wall, drive=straight),
        Added(hood, num_sweeps=5),  # it drives 2 m
        Added(hood, poses=False),
        Added(lambda *_: np.zeros((0, 3))),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert sum(num_left_out(OwnVehicleLog(log))) == 0
        assert next(one for one in OwnVehicleLog(log).findings() if one.topic == "own vehicle").status == RIGHT


def test_most_of_the_returns_are_not_those_of_the_vehicle():
    """Wrong poses of a sensor in a room: what it sees seems to ride along."""
    drive = drive_of(16)
    few, many = (np.random.default_rng(0).uniform(1, 2, (count, 3)) for count in (200, len(drive.sweep(0).points) + 9))
    assert sum(num_left_out(OwnVehicleLog(Added(lambda index, _: few)))) > 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sum(num_left_out(OwnVehicleLog(Added(lambda index, _: many)))) == 0


def test_points_upside_down_are_not_taken_for_the_vehicle():
    """Then the ground is not found, so its nearest rings seem to ride along."""
    drive = drive_of(16)
    down = np.diag([1.0, -1.0, -1.0, 1.0])

    class Down(Log):
        log_id, timestamps, poses = "down", drive.timestamps, np.asarray(drive.poses) @ down

        def sweep(self, index):
            sweep = drive.sweep(index)
            return Sweep(sweep.points @ down[:3, :3].astype(np.float32), None, self.poses[index], sweep.timestamp_ns)

    assert len(OwnVehicleLog(Down()).own_cells) == 0


def test_the_setting_keeps_them(hood, tmp_path):
    write_array_log(Added(hood), tmp_path)
    with pytest.warns(CFlowWarning, match="ride along"):
        log = open_log("arrays", tmp_path / "ride")
    assert num_left_out(log)[4] == 40
    assert sum(num_left_out(open_log("arrays", tmp_path / "ride", own_vehicle=None))) == 0
    with pytest.raises(CFlowError, match="own_vehicle='keep': choose one of auto, null"):
        open_log("arrays", tmp_path / "ride", own_vehicle="keep")
