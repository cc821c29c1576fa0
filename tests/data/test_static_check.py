"""Warnings when a log is opened: wrong poses, frames, units, axes and orders of sweeps."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import CachedLog
from cflow_torch.data.log_check import check_log, check_static_world, find_problems, static_world_residual
from cflow_torch.simulator import make_drive
from cflow_torch.types import CFlowWarning


class Changed:
    """A log with other poses, ground masks, points or order of sweeps; of a broken one no sweep can be read."""

    def __init__(self, log, pose=lambda pose: pose, masks=True, ground=True, points=None, order=None, is_broken=False):
        self.log, self.log_id, self.timestamps, self.labels = log, log.log_id, log.timestamps, log.labels
        self.pose, self.masks, self.ground, self.points, self.is_broken = pose, masks, ground, points, is_broken
        self.order = range(8) if order is None else order

    @property
    def poses(self):
        return self.pose and np.stack([self.pose(pose) for pose in self.log.poses])

    def sweep(self, index):
        if self.is_broken:
            raise CFlowError("broken")
        sweep = self.log.sweep(index)
        pose = None if self.pose is None else self.pose(sweep.pose)
        if callable(self.points):
            return Sweep(self.points(self.log.sweep(self.order[index]).points), None, pose, sweep.timestamp_ns)
        if self.points is not None:
            return Sweep(self.points, None, pose, sweep.timestamp_ns)
        kept = np.ones(len(sweep.points), bool) if self.ground else ~np.asarray(sweep.is_ground)
        mask = np.asarray(sweep.is_ground)[kept] if self.masks else None
        return Sweep(np.asarray(sweep.points)[kept], mask, pose, sweep.timestamp_ns)


def without_rotation(pose):
    return np.block([[np.eye(3), pose[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])


def verdict(log) -> str:
    """Return the warning of the check, "" = none."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = check_static_world(log)
    messages = [str(w.message) for w in caught if issubclass(w.category, CFlowWarning)]
    assert found and len(messages) <= 1
    assert bool(messages) == any(residual.verdict for residual in found)
    return messages[0] if messages else ""


@pytest.fixture(scope="module")
def drive():
    """A drive that begins to turn in its first second."""
    return CachedLog(make_drive(seed=2, num_sweeps=8, profile="demo"), 8)


@pytest.mark.parametrize("profile", ["av2", "nuscenes", "waymo", "truckscenes"])
def test_correct_poses_raise_no_warning(profile):
    """Truck scenes are not de-skewed, which must not look like a wrong frame at the beginning of a turn."""
    log = CachedLog(make_drive(seed=1, num_sweeps=6, profile=profile), 2)
    assert verdict(log) == "" and verdict(Changed(log, masks=False)) == ""


def test_mistakes_are_recognised(drive):
    points = drive.sweep(0).points
    assert verdict(Changed(drive, lambda pose: np.eye(4), points=points)) == "", "a static car"
    assert "inverted" in verdict(Changed(drive, np.linalg.inv))
    mixed = verdict(Changed(drive, lambda pose: pose @ np.linalg.inv(drive.units(0)[0].T_ego_sensor)))
    assert "ego_T_lidar" in mixed and drive.log_id in mixed
    millimetres = np.diag([1000.0, 1000, 1000, 1])
    for change in (without_rotation, lambda pose: millimetres @ pose @ np.linalg.inv(millimetres)):
        assert verdict(Changed(drive, change))
    assert "common frame" in verdict(Changed(drive, points=points))
    slow = Changed(drive, lambda pose: np.block([[np.eye(3), 0.15 * pose[:3, 3:]], [pose[3:]]]), points=points)
    assert "common frame" in static_world_residual(slow, 2).verdict, "both fit, but no motion fits far better"
    assert "no poses" in verdict(Changed(drive, pose=None))
    assert verdict(Changed(drive, pose=None, points=points)) == "", "a static sensor needs no poses"


def test_the_shift_equals_the_lever_arm(drive):
    """Sensor points with ego poses are off by (R - 1) t, where t is the mounting position."""
    to_sensor = np.linalg.inv(drive.units(0)[0].T_ego_sensor)
    log = Changed(drive, lambda pose: pose @ to_sensor)
    residual = static_world_residual(log, 1, 5)
    T_1_0, right = (np.linalg.inv(poses[6]) @ poses[1] for poses in (log.poses, drive.poses))
    miss = right[:2, 3] - T_1_0[:2, 3]
    lever = (np.eye(3) - T_1_0[:3, :3]) @ to_sensor[:3, 3]
    assert np.linalg.norm(miss) > 0.1 and np.allclose(miss, lever[:2], atol=1e-9)
    assert np.linalg.norm(residual.shift - miss) < 0.01
    assert residual.aligned > 2 * residual.agreement and abs(residual.rotation) < np.radians(0.05)


def test_real_drives_are_judged_correctly(av2_folder, kitti_file):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    log = CachedLog(AV2Log(av2_folder), 2)
    assert verdict(log) == "" and "inverted" in verdict(Changed(log, np.linalg.inv))
    with CachedLog(hdf5.HDF5Log(kitti_file), 4) as log:
        assert verdict(log) == "" and verdict(Changed(log, masks=False)) == ""
        assert "inverted" in verdict(Changed(log, np.linalg.inv)) and verdict(Changed(log, without_rotation))
        mount = np.eye(4)
        mount[:3, 3] = 1.35, 0, 1.64
        assert "ego_T_lidar" in verdict(Changed(log, lambda pose: pose @ np.linalg.inv(mount)))
        residual = static_world_residual(log, 0, 5)
        assert np.linalg.norm(residual.shift) < 0.02 and residual.agreement > 0.4


def test_too_few_points_raise_no_warning(drive):
    for points in (np.zeros((0, 3), np.float32), np.ones((50, 3), np.float32), np.full((9, 3), np.nan, np.float32)):
        log = Changed(drive, np.linalg.inv, points=points)
        assert verdict(log) == "" and np.isnan(static_world_residual(log, 0).agreement)


@pytest.mark.parametrize(
    ("change", "order", "found"),
    [
        (lambda points: 1000 * points, range(8), "in metres"),
        (lambda points: 0.001 * points, range(8), "in metres"),
        (lambda points: points + np.float32([500, 0, 0]), range(8), "frame of the LiDAR or of the vehicle"),
        (lambda points: points * np.float32([1, -1, -1]), range(8), "z seems to point down"),
        (lambda points: points, (0, 0, 2, 3, 4, 5, 6, 7), "the same points"),
        (lambda points: points, (0, 2, 1, 3, 4, 5, 6, 7), "interchanged"),
    ],
    ids=["millimetres", "kilometres", "elsewhere", "z down", "repeated", "interchanged"],
)
def test_wrong_sweeps_are_recognised(drive, change, order, found):
    assert any(found in text for text in find_problems(Changed(drive, points=change, order=order)))


def test_opening_a_log_warns_of_likely_mistakes(drive):
    with pytest.warns(CFlowWarning, match=f"log {drive.log_id}: .*static world moves"):
        check_log(Changed(drive, lambda pose: np.eye(4)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for good in (drive, Changed(drive, masks=False, ground=False), Changed(drive, is_broken=True)):
            check_log(good)
        assert find_problems(Changed(drive, points=np.asarray)) == []
