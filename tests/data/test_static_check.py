"""The static world stays put under right poses, and the check says what is wrong with wrong ones."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.writer import write_hdf5_scene
from cflow_torch.data.static_check import StaticWorldWarning, check_static_world, static_world_residual
from cflow_torch.simulator import make_drive

MOUNT = np.array([[1, 0, 0, 1.35], [0, 1, 0, 0], [0, 0, 1, 1.64], [0, 0, 0, 1.0]])


class Changed:
    """A log whose poses, ground masks or points are replaced."""

    def __init__(self, log, pose=lambda pose: pose, ground=True, points=None):
        self.log, self.log_id, self.timestamps, self.labels = log, log.log_id, log.timestamps, log.labels
        self.change, self.ground, self.points = pose, ground, points

    @property
    def poses(self):
        return np.stack([self.change(self.log.sweep(k).pose) for k in range(len(self.timestamps))])

    def sweep(self, index):
        sweep = self.log.sweep(index)
        points = sweep.points if self.points is None else self.points
        mask = sweep.is_ground if self.ground and self.points is None else None
        return Sweep(points, mask, self.change(sweep.pose), sweep.timestamp_ns)


def without_rotation(pose):
    return np.block([[np.eye(3), pose[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])


def verdict(log) -> str:
    """What the check warns of, "" = nothing."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = check_static_world(log)
    messages = [str(w.message) for w in caught if issubclass(w.category, StaticWorldWarning)]
    assert found and len(messages) <= 1
    assert bool(messages) == any(residual.verdict for residual in found)
    return messages[0] if messages else ""


@pytest.fixture(scope="module")
def drive():
    """It begins to turn in its first second."""
    return make_drive(seed=2, num_sweeps=8, profile="demo")


@pytest.mark.parametrize("profile", ["demo", "av2", "nuscenes", "waymo", "truckscenes", "aevascenes"])
def test_right_poses_are_let_through(profile):
    """Truck scenes are not de-skewed, which in the onset of a turn is no mistake of frames."""
    for seed in (0, 1):
        log = make_drive(seed=seed, num_sweeps=6, profile=profile)
        assert verdict(log) == ""
        assert verdict(Changed(log, ground=False)) == ""


def test_a_standing_car_and_a_straight_road_show_nothing(drive):
    still = Changed(drive, pose=lambda pose: np.eye(4), points=drive.sweep(0).points)
    assert verdict(still) == ""


def test_mistakes_are_named(drive):
    assert "inverted" in verdict(Changed(drive, np.linalg.inv))
    mixed = verdict(Changed(drive, lambda pose: pose @ np.linalg.inv(drive.units(0)[0].T_ego_sensor)))
    assert "ego_T_lidar" in mixed and drive.log_id in mixed
    assert verdict(Changed(drive, without_rotation))
    assert verdict(
        Changed(drive, lambda pose: np.diag([1000.0, 1000, 1000, 1]) @ pose @ np.diag([1e-3, 1e-3, 1e-3, 1]))
    )
    one_frame = Changed(drive, points=drive.sweep(0).points)
    assert "common frame" in verdict(one_frame)


def test_the_shift_is_the_one_of_the_lever_arm(drive):
    """Sensor points with ego poses miss by (R - 1) t, t = where the sensor sits."""
    mount = drive.units(0)[0].T_ego_sensor
    log = Changed(drive, lambda pose: pose @ np.linalg.inv(mount))
    residual = static_world_residual(log, 1, 5)
    T_1_0 = np.linalg.inv(log.poses[6]) @ log.poses[1]
    # Points lie in the drive's own frame, poses are those of a frame whose origin lies at -t in it.
    lever = np.linalg.inv(mount)[:3, 3]
    expected = np.linalg.inv(drive.poses[6]) @ drive.poses[1]
    miss = expected[:2, 3] - T_1_0[:2, 3]
    assert np.linalg.norm(miss) > 0.1 and np.allclose(miss, ((np.eye(3) - T_1_0[:3, :3]) @ lever)[:2], atol=1e-9)
    assert np.linalg.norm(residual.shift - miss) < 0.01
    assert residual.aligned > 2 * residual.agreement and abs(residual.turn) < np.radians(0.05)


def test_scenes_of_the_harness(tmp_path, drive):
    """OpenSceneFlow's Argoverse 2 layout: taken as it is the world slips, with the extrinsics it stays."""
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5.reader")
    pytest.importorskip("h5py")
    write_hdf5_scene(drive, tmp_path / "a.h5", "sensor", store_extrinsics=False)
    with hdf5.HDF5Log(tmp_path / "a.h5") as log:
        assert verdict(log) == ""
    with hdf5.HDF5Log(tmp_path / "a.h5", ego_T_lidar=None) as log:
        assert "ego_T_lidar" in verdict(log)


def test_real_drives(av2_folder, kitti_file):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5.reader")
    pytest.importorskip("h5py")
    log = AV2Log(av2_folder)
    assert verdict(log) == "" and "inverted" in verdict(Changed(log, np.linalg.inv))
    with hdf5.HDF5Log(kitti_file) as log:
        assert verdict(log) == "" and verdict(Changed(log, ground=False)) == ""
        assert "inverted" in verdict(Changed(log, np.linalg.inv))
        assert "ego_T_lidar" in verdict(Changed(log, lambda pose: pose @ np.linalg.inv(MOUNT)))
        assert verdict(Changed(log, without_rotation))
        residual = static_world_residual(log, 0, 5)
        assert np.linalg.norm(residual.shift) < 0.02 and residual.agreement > 0.4


def test_too_little_to_see(drive):
    for points in (np.zeros((0, 3), np.float32), np.ones((50, 3), np.float32), np.full((9, 3), np.nan, np.float32)):
        log = Changed(drive, np.linalg.inv, points=points)
        assert verdict(log) == ""
        assert np.isnan(static_world_residual(log, 0).agreement)


def test_logs_without_poses_and_wrong_calls(drive):
    class NoPoses(Changed):
        def sweep(self, index):
            return Sweep(self.log.sweep(index).points)

    assert check_static_world(NoPoses(drive)) == []
    with pytest.raises(CFlowError, match="odometry"):
        static_world_residual(NoPoses(drive), 0)
    for index, baseline in ((-1, 5), (3, 5), (0, 0)):
        with pytest.raises(CFlowError, match="no pair"):
            static_world_residual(drive, index, baseline)
