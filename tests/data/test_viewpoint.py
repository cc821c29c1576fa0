"""PCD files with poses in VIEWPOINT, with points in the frame of the sensor or of the world."""

from __future__ import annotations

import numpy as np
import pytest
from small_logs import make_small_drive

from cflow_torch import CFlowError
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.arrays.cloud_file import read_cloud, write_cloud
from cflow_torch.data.catalog import open_log
from cflow_torch.data.read_as import ReadAs
from cflow_torch.transforms import as_matrix, rotations_about, to_quaternions, transform_points
from cflow_torch.types import CFlowWarning

pytest.importorskip("pypcd4", reason="needs the extra clouds: pip install pypcd4")


THIN = slice(None, None, 3)  # rows of a sweep that are written
IN_PLACE = np.eye(4)


def write_drive(root, frame: str, origin: float, mount=IN_PLACE):
    """Write a third of the demo drive, and return it with its poses, of which the first is at x = `origin`.

    VIEWPOINT is the pose of a LiDAR, `mount` its place on the vehicle.
    """
    drive = make_small_drive(4, seed=1)
    to_start = np.linalg.inv(drive.poses[0])
    to_start[0, 3] += origin
    poses = to_start @ drive.poses
    for k, pose in enumerate(poses):
        sweep = drive.sweep(k)
        points = sweep.points[THIN]
        points = transform_points(points, np.linalg.inv(mount) if frame == "sensor" else pose).astype(np.float32)
        lidar = pose @ mount
        viewpoint = (*lidar[:3, 3], *to_quaternions(lidar[None, :3, :3])[0])
        write_cloud(root / f"{k}.pcd", points, viewpoint=viewpoint)
    return drive, poses


@pytest.mark.parametrize(
    ("frame", "origin"),
    [
        ("sensor", 0),
        ("world", 300),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("sensor", 300), ("world", 0))),
    ],
)
def test_poses_are_read_and_the_frame_is_found(tmp_path, frame: str, origin: float) -> None:
    drive, poses = write_drive(tmp_path, frame, origin)
    with pytest.warns(CFlowWarning, match="poses come from VIEWPOINT"):
        log = open_log("arrays", tmp_path)
    for k in range(4):
        assert np.allclose(log.sweep(k).pose, poses[k], atol=1e-6)
        assert np.allclose(log.sweep(k).points, drive.sweep(k).points[THIN], atol=1e-3)
    other = open_log("arrays", tmp_path, read_as=None if frame == "world" else "world", check=False)
    assert np.abs(other.sweep(3).points - drive.sweep(3).points[THIN]).max() > 1
    assert ArraysLog(tmp_path, poses=None).poses is None


@pytest.mark.parametrize(("frame", "origin"), [("sensor", 0), ("world", 300)])
def test_viewpoints_are_poses_of_the_lidar(tmp_path, frame: str, origin: float) -> None:
    mount = as_matrix(rotations_about(0, np.radians(25)), (1, 0.5, 1.8))
    drive, poses = write_drive(tmp_path, frame, origin, mount)
    log = ArraysLog(tmp_path, ego_T_lidar=mount)
    log = log if frame == "sensor" else ReadAs(log, "world")
    for k in range(4):
        assert np.allclose(log.sweep(k).pose, poses[k], atol=1e-6)
        assert np.allclose(log.sweep(k).points, drive.sweep(k).points[THIN], atol=1e-3)
    given = ArraysLog(tmp_path, ego_T_lidar=mount, poses_of="ego")
    assert np.allclose(given.poses, poses @ mount, atol=1e-6)


@pytest.mark.parametrize("frame", [pytest.param("sensor", marks=pytest.mark.slow), "world"])
def test_cleaned_clouds_have_the_same_form(tmp_path, frame: str) -> None:
    """`cflow clean` writes VIEWPOINT and points in the frame of the input, and its output is read like the input."""
    pytest.importorskip("hydra")
    from command_line import cflow

    (tmp_path / "drive" / "pcd").mkdir(parents=True)
    _, poses = write_drive(tmp_path / "drive" / "pcd", frame, 300)
    given = read_cloud(tmp_path / "drive" / "pcd" / "2.pcd")
    model = ("model.num_history=0", "model.pixel_sizes=[0.4,0.2]")
    assert cflow("clean", tmp_path / "drive", f"output={tmp_path / 'out'}", "map=true", *model) == 0
    folder = tmp_path / "out" / "drive"
    assert not (folder / "poses.txt").exists()
    kept = read_cloud(folder / "points" / "2.pcd")
    assert 0.5 * len(given) < len(kept) < len(given)
    assert np.array_equal(kept, given[~np.load(folder / "removed" / "2.npy")])
    log = open_log("arrays", folder)
    assert np.allclose(log.poses, poses, atol=1e-6) and log.readings == (("world",) if frame == "world" else ())
    world = read_cloud(tmp_path / "out" / "drive" / "map.ply")
    assert abs(np.median(world[:, 0]) - 300) < 60, "the map is in the world"


def test_viewpoints_need_poses_and_pcd(tmp_path) -> None:
    drive = make_small_drive(2, seed=1)
    with pytest.raises(CFlowError, match="viewpoint='world' with suffix='.npy'"):
        write_array_log(drive, tmp_path, ".npy", "world")


def test_viewpoints_of_zeros_are_lost_poses(tmp_path) -> None:
    for k in range(4):
        viewpoint = (0.0,) * 7 if k == 2 else (k, 0, 0, 1, 0, 0, 0)
        write_cloud(tmp_path / f"{k}.pcd", np.full((3, 3), k + 1, np.float32), viewpoint=viewpoint)
    with pytest.warns(CFlowWarning, match="1 of 4 sweeps have no pose, or one of NaN or zeros"):
        log = ArraysLog(tmp_path)
    assert log.poses[:, 0, 3].tolist() == [0, 1, 3] and log.gaps == {1}


def test_unset_viewpoints_are_no_poses(tmp_path) -> None:
    for k in range(2):
        write_cloud(tmp_path / f"{k}.pcd", np.ones((3, 3), np.float32))
    assert ArraysLog(tmp_path).poses is None
