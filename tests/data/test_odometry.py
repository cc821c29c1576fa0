"""Poses estimated by KISS-ICP for logs without poses, and its own loaders."""

from __future__ import annotations

import sys
from importlib.util import find_spec

import numpy as np
import pytest

from cflow_torch import CFlowError, Sweep
from cflow_torch.data.arrays.cloud_file import write_cloud
from cflow_torch.data.arrays.poses_text import write_kitti_poses
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.log import LogWrapper
from cflow_torch.data.log_motion import judge_log
from cflow_torch.data.odometry import PosedLog, poses_from_odometry, with_poses
from cflow_torch.simulator import make_drive

needs_kiss_icp = pytest.mark.skipif(find_spec("kiss_icp") is None, reason="needs KISS-ICP (extra odometry)")


class NoPoses(LogWrapper):
    """A log without poses."""

    def sweep(self, index):
        return Sweep(self.log.sweep(index).points)


class Empty(LogWrapper):
    """A log of sweeps without a finite point."""

    def sweep(self, index):
        return Sweep(np.full((200, 3), np.nan, np.float32))


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=2, num_sweeps=8, profile="demo")


def drift(poses: np.ndarray, truth: np.ndarray):
    """Return the error of the last pose relative to the first, in metres and degrees."""
    difference = np.linalg.inv(np.linalg.inv(truth[0]) @ truth[-1]) @ np.linalg.inv(poses[0]) @ poses[-1]
    angle = np.degrees(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
    return np.linalg.norm(difference[:3, 3]), angle


@needs_kiss_icp
def test_poses_of_a_simulated_drive_are_estimated(drive):
    poses = poses_from_odometry(NoPoses(drive))
    assert np.array_equal(poses[0], np.eye(4))
    for index in range(7):  # including the first steps, where KISS-ICP alone is off by 14 cm
        metres, degrees = drift(poses[index : index + 2], drive.poses[index : index + 2])
        assert metres < 0.05 and degrees < 0.2, index
    assert np.array_equal(poses, poses_from_odometry(NoPoses(drive))), "the same again"
    with pytest.raises(CFlowError, match="fewer than 100 points"):
        poses_from_odometry(Empty(drive))


@needs_kiss_icp
def test_poses_of_the_real_drive_are_estimated(kitti_file):
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    with hdf5.HDF5Log(kitti_file) as log:
        poses = poses_from_odometry(NoPoses(log))
        metres, degrees = drift(poses, log.poses)
        assert metres < 0.1 and degrees < 0.5, "after 5 m and 11 degrees"
        assert judge_log(PosedLog(log, poses)).best == ()


def test_without_kiss_icp_the_message_names_the_fix(drive, monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "kiss_icp"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "kiss_icp", None)
    for call in (poses_from_odometry, with_poses):
        with pytest.raises(CFlowError, match=r"pip install kiss-icp.*poses\.txt"):
            call(NoPoses(drive))
    assert with_poses(drive) is drive, "nothing is estimated where poses are known"


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
