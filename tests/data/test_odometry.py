"""Poses estimated from the points, and the loaders of KISS-ICP."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.arrays.cloud_file import write_cloud
from cflow_torch.data.arrays.poses_text import write_kitti_poses
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.deskewing import DeskewedLog
from cflow_torch.data.log import LogWrapper
from cflow_torch.data.log_check import find_problems
from cflow_torch.data.log_motion import judge_log
from cflow_torch.data.odometry import Odometry, PosedLog, estimate_poses, with_poses
from cflow_torch.simulator import make_drive

needs_gicp = pytest.mark.skipif(find_spec("small_gicp") is None, reason="needs small_gicp (extra odometry)")
needs_kiss_icp = pytest.mark.skipif(find_spec("kiss_icp") is None, reason="needs KISS-ICP (extra kiss-icp)")


class NoPoses(LogWrapper):
    """A log without poses."""

    def sweep(self, index):
        return Sweep(self.log.sweep(index).points)


class Empty(LogWrapper):
    """A log of sweeps without a finite point."""

    def sweep(self, index):
        return Sweep(np.full((200, 3), np.nan, np.float32))


def rigid(yaw: float, shift: np.ndarray) -> np.ndarray:
    """Return the transform of a turn, radians, and a shift in x and y, metres."""
    matrix = np.eye(4)
    matrix[:2, :2] = ((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw)))
    matrix[:2, 3] = shift
    return matrix


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=2, num_sweeps=8, profile="demo")


def drift(poses: np.ndarray, truth: np.ndarray):
    """Return the error of the last pose relative to the first, in metres and degrees."""
    difference = np.linalg.inv(np.linalg.inv(truth[0]) @ truth[-1]) @ np.linalg.inv(poses[0]) @ poses[-1]
    angle = np.degrees(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
    return np.linalg.norm(difference[:3, 3]), angle


@needs_gicp
def test_poses_of_a_simulated_drive_are_estimated(drive):
    poses = estimate_poses(NoPoses(drive))
    assert np.array_equal(poses[0], np.eye(4))
    for index in range(7):  # including the first step, which starts from rest
        metres, degrees = drift(poses[index : index + 2], drive.poses[index : index + 2])
        assert metres < 0.025 and degrees < 0.1, index
    assert np.array_equal(poses, estimate_poses(NoPoses(drive))), "the same again"
    with pytest.raises(CFlowError, match="fewer than 100 points"):
        estimate_poses(Empty(drive))


@needs_gicp
def test_poses_of_the_real_drive_are_estimated(kitti_file):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    with hdf5.HDF5Log(kitti_file) as log:
        poses = estimate_poses(NoPoses(log))
        for index in range(len(poses) - 1):
            metres, degrees = drift(poses[index : index + 2], log.poses[index : index + 2])
            assert metres < 0.01 and degrees < 0.05, index
        metres, degrees = drift(poses, log.poses)
        assert metres < 0.1 and degrees < 0.2, "after 5 m and 11 degrees"
        assert judge_log(PosedLog(log, poses)).best == ()


@needs_gicp
def test_a_fast_vehicle_is_found_from_rest(drive):
    """Every third sweep: the vehicle moves by about 1.9 m."""
    thinned = PosedLog(NoPoses(drive), drive.poses)
    odometry = Odometry()
    poses = np.stack([odometry.next_pose(thinned.sweep(index).points, "the sweep") for index in (0, 3, 6)])
    for pair in range(2):
        truth = drive.poses[[3 * pair, 3 * pair + 3]]
        assert np.linalg.norm(truth[1][:3, 3] - truth[0][:3, 3]) > 1.5
        assert drift(poses[pair : pair + 2], truth)[0] < 0.05


@needs_gicp
def test_noisy_poses_are_refined(drive):
    rng = np.random.default_rng(3)
    noise = [rigid(rng.normal(0, 0.004), rng.normal(0, 0.05, 2)) for _ in drive.poses]
    noisy = PosedLog(drive, np.stack([pose @ error for pose, error in zip(drive.poses, noise)]))
    refined = with_poses(noisy, refine=True)
    for index in range(7):
        truth = drive.poses[index : index + 2]
        of_noisy, of_refined = (drift(log.poses[index : index + 2], truth) for log in (noisy, refined))
        assert of_refined[0] < 0.05 and of_refined[1] < 0.1
        assert of_noisy[0] > 0.05 or of_noisy[1] > 0.1, "there was something to refine"


@needs_gicp
def test_poses_that_you_do_not_want_are_replaced(drive):
    wrong = PosedLog(drive, drive.poses[::-1].copy())
    assert np.array_equal(with_poses(wrong).poses, estimate_poses(NoPoses(drive)))


def test_poses_of_our_own_are_not_blamed_on_the_user(drive):
    """They are estimated, so their units, axes and times are right."""
    wrong = drive.poses.copy()
    wrong[:, :3, 3] *= 0.8
    texts = [find_problems(PosedLog(drive, wrong, are_estimated=each)) for each in (False, True)]
    assert texts[0][0].startswith("the static world moves under the poses")
    assert texts[1][0].startswith("the poses that we estimated from the points do not fit well (only 0.")
    assert DeskewedLog(PosedLog(drive, wrong, are_estimated=True)).has_estimated_poses


def test_without_the_package_the_message_names_the_fix(drive, monkeypatch):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    for call in (estimate_poses, with_poses):
        with pytest.raises(CFlowError, match=r"pip install small-gicp.*poses\.txt"):
            call(NoPoses(drive))


def test_poses_of_a_loader_that_are_not_one_per_sweep_are_refused(tmp_path, monkeypatch):
    class Three(list):
        gt_poses = np.tile(np.eye(4), (2, 1, 1))

    loaders = SimpleNamespace(available_dataloaders=lambda: ["kitti"], dataset_factory=lambda *_: Three([0, 0, 0]))
    monkeypatch.setitem(sys.modules, "kiss_icp", loaders)
    monkeypatch.setitem(sys.modules, "kiss_icp.datasets", loaders)
    with pytest.raises(CFlowError, match="loader kitti has 2 poses for 3 sweeps"):
        open_log("kiss_icp", tmp_path, loader="kitti")


@needs_kiss_icp
def test_loaders_of_kiss_icp_are_logs(drive, tmp_path):
    """KITTI's layout, whose scans the loader corrects by a fifth of a degree."""
    folder = tmp_path / "sequences" / "03"
    (folder / "velodyne").mkdir(parents=True)
    (tmp_path / "poses").mkdir()
    for index in range(3):
        write_cloud(folder / "velodyne" / f"{index:06d}.bin", drive.sweep(index).points)
    (folder / "calib.txt").write_text("Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    write_kitti_poses(tmp_path / "poses" / "03.txt", drive.poses[:3])
    (source,) = find_sources("kiss_icp", tmp_path)
    log = open_log("kiss_icp", source, check=False, loader="kitti", sequence="03")
    assert len(log.timestamps) == 3 and log.log_id == f"{tmp_path.name}-03" and log.labels(0) is None
    assert np.allclose(log.sweep(2).pose, drive.poses[2], atol=1e-6)
    given, read = drive.sweep(1).points, log.sweep(1).points
    assert read.dtype == np.float32
    assert (np.linalg.norm(read - given, axis=1) < 0.01 * np.linalg.norm(given, axis=1)).all()
    for settings, message in (
        ({"loader": "mcap"}, "choose one of apollo.*or use data=bags"),
        ({"loader": "kitti"}, "loader kitti fails: .*sequence"),
        ({"loader": "apollo"}, "fails: .*open3d"),
    ):
        with pytest.raises(CFlowError, match=message):
            open_log("kiss_icp", source, **settings)
