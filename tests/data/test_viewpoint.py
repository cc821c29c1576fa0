"""PCD files with poses in VIEWPOINT, with points in the frame of the sensor or of the world."""

from __future__ import annotations

import numpy as np
import pytest

from cflow_torch import CFlowError
from cflow_torch.data.arrays import ArraysLog
from cflow_torch.data.arrays.cloud_file import write_cloud
from cflow_torch.data.rigid_motion import to_quaternions, transform_points
from cflow_torch.simulator import make_drive
from cflow_torch.types import CFlowWarning

pytest.importorskip("pypcd4", reason="needs the extra clouds: pip install pypcd4")


@pytest.mark.parametrize(("frame", "origin"), [("sensor", 0), ("world", 0), ("world", 300)])
def test_poses_are_read_and_the_frame_is_found(tmp_path, frame: str, origin: float) -> None:
    drive = make_drive(seed=1, num_sweeps=4, profile="demo")
    to_start = np.linalg.inv(drive.poses[0])
    to_start[0, 3] += origin
    for k in range(4):
        sweep, pose, file = drive.sweep(k), to_start @ drive.poses[k], tmp_path / f"{k}.pcd"
        points = sweep.points if frame == "sensor" else transform_points(sweep.points, pose).astype(np.float32)
        write_cloud(file, points)
        numbers = " ".join(f"{value:.12g}" for value in (*pose[:3, 3], *to_quaternions(pose[None, :3, :3])[0]))
        default = b"VIEWPOINT 0.0 0.0 0.0 1.0 0.0 0.0 0.0"
        content = file.read_bytes()
        assert default in content
        file.write_bytes(content.replace(default, f"VIEWPOINT {numbers}".encode()))
    with pytest.warns(CFlowWarning, match=f"come from VIEWPOINT; we take its points to be in the {frame}'s frame"):
        log = ArraysLog(tmp_path)
    for k in range(4):
        assert np.allclose(log.sweep(k).pose, to_start @ drive.poses[k], atol=1e-6)
        assert np.allclose(log.sweep(k).points, drive.sweep(k).points, atol=1e-3)
    other = ArraysLog(tmp_path, points_frame="lidar" if frame == "world" else "world")
    assert np.abs(other.sweep(3).points - drive.sweep(3).points).max() > 1
    assert ArraysLog(tmp_path, poses=None).poses is None
    with pytest.raises(CFlowError, match="points_frame=world: .* has no poses"):
        ArraysLog(tmp_path, poses=None, points_frame="world")


def test_unset_viewpoints_are_no_poses(tmp_path) -> None:
    for k in range(2):
        write_cloud(tmp_path / f"{k}.pcd", np.ones((3, 3), np.float32))
    assert ArraysLog(tmp_path).poses is None
