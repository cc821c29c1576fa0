"""KITTI in its four layouts, written by hand: two poses of a vehicle, a box that drives, and a wall."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_bin_layout import street

from cflow_torch.data.catalog import Logs, find_all_sources, find_sources, open_log, recognise, source_name
from cflow_torch.data.kitti import KITTILog, find_kitti_drives
from cflow_torch.transforms import rotations_about
from cflow_torch.types import CFlowError, CFlowWarning

STEP, CAR = 0.4, 0.7  # metres a sweep: the vehicle, and the car in the world
T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0.01], [0, 0, -1, -0.07], [1, 0, 0, -0.27], [0, 0, 0, 1]])
T_LIDAR_IMU = np.array([[1.0, 0, 0, -0.81], [0, 1, 0, 0.32], [0, 0, 1, -0.8], [0, 0, 0, 1]])
PROJECTION = np.array([[720.0, 0, 621, 45], [0, 720, 187, 0], [0, 0, 1, 0]])
WALL = np.array([[12.0, -5, 0.1], [12, -4, 0.1], [-8, 3, 0.1], [12, -9, -0.2]])


def cloud(index: int) -> np.ndarray:
    """Return (N, 4): three points of a car ahead, then a wall, of which one point is behind and two are in view."""
    car = np.array([[15.0, 1.2, -1], [15.5, 1, -0.6], [14.4, 0.8, -0.8]]) + ((CAR - STEP) * index, 0, 0)
    points = np.concatenate([car, WALL - (STEP * index, 0, 0)])
    return np.column_stack([points, np.linspace(0, 0.9, len(points))])


def write_clouds(folder: Path, count: int, form: str = "{:06d}") -> None:
    folder.mkdir(parents=True)
    for index in range(count):
        cloud(index).astype("<f4").tofile(folder / (form.format(index) + ".bin"))


def text(matrix: np.ndarray) -> str:
    return " ".join(f"{value:.12e}" for value in np.ravel(matrix))


def oxts(index: int) -> str:
    """Return a measurement of a vehicle that drives north-west at 49 degrees, 8.4 degrees east."""
    metres = STEP * index / np.sqrt(2)
    scale = 6378137.0 * np.cos(np.radians(49.0))
    north = np.log(np.tan(np.pi / 4 + np.radians(49.0) / 2)) + metres / scale
    latitude = np.degrees(2 * np.arctan(np.exp(north)) - np.pi / 2)
    longitude = 8.4 - np.degrees(metres / scale)
    return f"{latitude:.14f} {longitude:.14f} 112.0 0 0 {3 * np.pi / 4:.14f} " + "0 " * 24 + "\n"


def write_raw(folder: Path, count: int = 3, first: int = 0) -> Path:
    write_clouds(folder / "velodyne_points" / "data", count, "{:010d}")
    lines = [f"2011-09-26 13:02:25.{594360375 + 103_000_000 * index:09d}\n" for index in range(3)]
    (folder / "velodyne_points" / "timestamps.txt").write_text("".join(lines))
    (folder / "oxts" / "data").mkdir(parents=True)
    for index in range(count):
        (folder / "oxts" / "data" / f"{index:010d}.txt").write_text(oxts(index))
    poses = "".join(
        f"<item><tx>{15 + (CAR - STEP) * index}</tx><ty>1</ty><tz>-1.6</tz><rx>0</rx><ry>0</ry><rz>0.1</rz>"
        "<state>2</state><occlusion>0</occlusion><truncation>0</truncation></item>"
        for index in range(count)
    )
    (folder / "tracklet_labels.xml").write_text(
        '<?xml version="1.0"?><!DOCTYPE boost_serialization><boost_serialization><tracklets><count>1</count>'
        f"<item><objectType>Van</objectType><h>2</h><w>1.8</w><l>4</l><first_frame>{first}</first_frame>"
        f"<poses><count>{count}</count>{poses}</poses></item></tracklets></boost_serialization>"
    )
    day = folder.parent
    rigid = f"R: {text(T_LIDAR_IMU[:3, :3])}\nT: {text(T_LIDAR_IMU[:3, 3])}\n"
    (day / "calib_imu_to_velo.txt").write_text(f"calib_time: 25-May-2012 16:47:16\n{rigid}")
    rigid = f"R: {text(T_CAMERA_LIDAR[:3, :3])}\nT: {text(T_CAMERA_LIDAR[:3, 3])}\n"
    (day / "calib_velo_to_cam.txt").write_text(f"calib_time: 15-Mar-2012 11:37:16\n{rigid}delta_f: 0 0\n")
    camera = f"corner_dist: 9.95e-02\nR_rect_00: {text(np.eye(3))}\n"
    camera += f"S_rect_02: 1.226e+03 3.7e+02\nP_rect_02: {text(PROJECTION)}\n"
    (day / "calib_cam_to_cam.txt").write_text(camera)
    return folder


def write_kitti360(root: Path, of_camera: bool) -> Path:
    """Four sweeps; the first has no pose. Poses are of the IMU, or of the rectified camera 0."""
    name = "2013_05_28_drive_0000_sync"
    folder = root / "data_3d_raw" / name
    write_clouds(folder / "velodyne_points" / "data", 4, "{:010d}")
    lines = [f"2013-05-28 08:46:02.{100_000_000 + 103_000_000 * index:09d}\n" for index in range(4)]
    (folder / "velodyne_points" / "timestamps.txt").write_text("".join(lines))
    rectified = np.eye(4)
    rectified[:3, :3] = rotations_about(1, 0.01)
    T_pose_lidar = rectified @ T_CAMERA_LIDAR if of_camera else np.linalg.inv(T_LIDAR_IMU)
    (root / "calibration").mkdir()
    calibration = root / "calibration"
    (calibration / "calib_cam_to_velo.txt").write_text(text(np.linalg.inv(T_CAMERA_LIDAR)[:3]) + "\n")
    (calibration / "perspective.txt").write_text(f"R_rect_00: {text(rectified[:3, :3])}\n")
    if not of_camera:
        T_imu_camera = T_pose_lidar @ np.linalg.inv(T_CAMERA_LIDAR)
        (calibration / "calib_cam_to_pose.txt").write_text(f"image_00: {text(T_imu_camera[:3])}\n")
    lines = []
    for index in (1, 2, 3):
        T_world_lidar = np.eye(4)
        T_world_lidar[:3, 3] = 900 + STEP * index, 3700, 110
        pose = T_world_lidar @ np.linalg.inv(T_pose_lidar)
        lines.append(f"{index} {text(pose if of_camera else pose[:3])}\n")
    (root / "data_poses" / name).mkdir(parents=True)
    (root / "data_poses" / name / ("cam0_to_world.txt" if of_camera else "poses.txt")).write_text("".join(lines))
    return folder


def write_tracking(root: Path) -> Path:
    write_clouds(root / "velodyne" / "0003", 3)
    for name in ("calib", "oxts", "label_02"):
        (root / name).mkdir()
    (root / "calib" / "0003.txt").write_text(
        f"P2: {text(PROJECTION)}\nR_rect {text(np.eye(3))}\nTr_velo_cam {text(T_CAMERA_LIDAR[:3])}\n"
        f"Tr_imu_velo {text(T_LIDAR_IMU[:3])}\n"
    )
    (root / "oxts" / "0003.txt").write_text("".join(map(oxts, range(3))))
    lines = []
    for index in range(3):
        x, y, z, _ = T_CAMERA_LIDAR @ (15 + (CAR - STEP) * index, 1, -1.6, 1)
        lines.append(f"{index} 7 Van 0 0 -1.6 0 0 9 9 2 1.8 4 {x} {y} {z} {-np.pi / 2 - 0.1}\n")
        lines.append(f"{index} -1 DontCare -1 -1 -10 900 100 950 200 -1 -1 -1 -1000 -1000 -1000 -10\n")
    (root / "label_02" / "0003.txt").write_text("".join(lines))
    return root


def write_sequence(folder: Path, are_of_camera: bool = True, has_classes: bool = False) -> Path:
    write_clouds(folder / "velodyne", 3)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = STEP * np.arange(3)
    if are_of_camera:
        poses = T_CAMERA_LIDAR @ poses @ np.linalg.inv(T_CAMERA_LIDAR)
    (folder / "poses.txt").write_text("".join(text(pose[:3]) + "\n" for pose in poses))
    (folder / "calib.txt").write_text(f"P0: {text(PROJECTION)}\nTr: {text(T_CAMERA_LIDAR[:3])}\n")
    (folder / "times.txt").write_text("0.0\n0.103\n0.207\n")
    if has_classes:
        (folder / "labels").mkdir()
        for index in range(3):
            classes = np.array([258, 258, 10, 50, 0, 50, 40], "<u4") + (5 << 16)
            classes.astype("<u4").tofile(folder / "labels" / f"{index:06d}.label")
    return folder


def check_motion(log: Any) -> None:
    """Check the poses, and the truth of a car with a box."""
    for index in (1, 2):
        assert np.allclose(np.linalg.inv(log.poses[index - 1]) @ log.poses[index], step_pose(), atol=1e-5)
    labels = log.labels(0)
    residual = labels.flow + (STEP, 0, 0)
    assert np.allclose(residual[:3], (CAR, 0, 0), atol=1e-4) and np.allclose(residual[3:], 0, atol=1e-4)
    assert (labels.category > 0).tolist() == [True] * 3 + [False] * 4
    assert log.labels(2) is None


def step_pose() -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = STEP
    return pose


def test_a_raw_drive_has_poses_of_the_lidar_times_and_boxes(tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "2011_09_26" / "2011_09_26_drive_0027_sync")
    for path in (tmp_path, folder, folder / "velodyne_points" / "data"):
        assert recognise(path) == "kitti" and len(find_sources("kitti", path)) == 1
    log: Any = open_log("kitti", *find_sources("kitti", tmp_path), check=False)
    assert log.log_id == "2011_09_26_drive_0027_sync"
    assert log.timestamps == [1317042145_594360375 + 103_000_000 * index for index in range(3)]
    check_motion(log)
    assert log.labels(0).is_valid.tolist() == [True] * 5 + [False, True], "behind is not annotated"
    assert np.allclose(log.columns(1)["reflectance"], np.linspace(0, 0.9, 7))
    again = pickle.loads(pickle.dumps(log))
    assert np.array_equal(again.labels(0).flow, log.labels(0).flow)
    assert KITTILog(folder, poses=None).sweep(0).pose is None


@pytest.mark.parametrize(
    ("missing", "message"),
    [("oxts/data/*[12].txt", "1 measurements for 3 sweeps"), ("../calib_imu_to_velo.txt", "calib_imu_to_velo")],
)
def test_a_raw_drive_without_what_poses_need_says_so(missing: str, message: str, tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "day" / "drive")
    for file in folder.glob(missing):
        file.unlink()
    with pytest.warns(CFlowWarning, match=f"{message}.*no poses.*odometry"):
        log = KITTILog(folder)
    assert log.poses is None and log.sweep(0).pose is None and log.labels(0) is None


def test_a_sweep_of_a_raw_drive_without_measurement_is_left_out(tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "day" / "drive")
    whole = KITTILog(folder)
    (folder / "oxts" / "data" / "0000000001.txt").unlink()
    with pytest.warns(CFlowWarning, match="1 of 3 sweeps have no pose, .* left out"):
        log = KITTILog(folder)
    assert log.timestamps == whole.timestamps[::2] and np.allclose(log.poses, whole.poses[::2]) and log.gaps == {0}


def test_a_raw_drive_with_an_empty_measurement_or_without_the_folder_data_is_read(tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "day" / "drive")
    whole = KITTILog(folder)
    (folder / "oxts" / "data" / "0000000001.txt").write_text("")  # of a download that was cut off
    with pytest.warns(CFlowWarning, match="1 of 3 sweeps have no pose"):
        assert np.allclose(KITTILog(folder).poses, whole.poses[::2])
    (folder / "oxts" / "data" / "0000000001.txt").write_text(oxts(1))
    for file in (folder / "velodyne_points" / "data").iterdir():
        file.rename(folder / "velodyne_points" / file.name)
    (folder / "velodyne_points" / "data").rmdir()
    assert recognise(tmp_path) == "kitti"
    (drive,) = find_kitti_drives(tmp_path)
    assert drive.name == "drive" and np.allclose(KITTILog(drive).poses, whole.poses)


def test_a_measurement_that_is_cut_and_an_empty_line_of_times_lose_one_sweep(tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "day" / "drive", 4)
    times = folder / "velodyne_points" / "timestamps.txt"
    lines = times.read_text().splitlines(keepends=True)
    times.write_text("".join([*lines[:2], "\n", lines[2]]))
    (folder / "velodyne_points" / "data" / "0000000002.bin").unlink()
    for content in (oxts(1)[:50], "  \n", "\0" * 90):
        (folder / "oxts" / "data" / "0000000001.txt").write_text(content)
        with pytest.warns(CFlowWarning, match="1 of 3 sweeps have no pose"):
            log = KITTILog(folder)
        assert log.timestamps == [1317042145_594360375 + 103_000_000 * index for index in (0, 2)]
        assert np.allclose(
            np.linalg.inv(log.poses[0]) @ log.poses[1], np.linalg.matrix_power(step_pose(), 3), atol=1e-5
        )


def test_a_drive_that_is_not_synchronised_takes_poses_by_their_times(tmp_path: Path) -> None:
    """Drives called _extract have clouds as texts, and ten measurements a sweep."""
    folder = write_raw(tmp_path / "day" / "drive_extract")
    whole = KITTILog(folder)
    clouds, measured = folder / "velodyne_points" / "data", folder / "oxts" / "data"
    for index in range(3):
        (clouds / f"{index:010d}.bin").unlink()
        np.savetxt(clouds / f"{index:010d}.txt", np.tile(cloud(index), (4, 1)), "%.3f")
        (measured / f"{index:010d}.txt").unlink()
    times = [0.594360375 + 0.0103 * index for index in range(21)]
    for index in range(21):
        (measured / f"{index:010d}.txt").write_text(oxts(index / 10))  # type: ignore[arg-type]
    stamps = "".join(f"2011-09-26 13:02:{25 + time:.9f}\n" for time in times)
    (folder / "oxts" / "timestamps.txt").write_text(stamps)
    for k, name in enumerate((4, 5)):  # the other way round, as some of KITTI's are
        (measured / f"{name:010d}.txt").write_text(oxts((5 - k) / 10))  # type: ignore[arg-type]
    swapped = stamps.splitlines(keepends=True)
    swapped[4:6] = swapped[5:3:-1]
    (folder / "oxts" / "timestamps.txt").write_text("".join(swapped))
    log = KITTILog(folder)
    assert log.timestamps == whole.timestamps and np.allclose(log.poses, whole.poses, atol=1e-6)
    assert log.trajectory is not None and len(log.trajectory[0]) == 21
    assert np.allclose(log.sweep(1).points[:7], cloud(1)[:, :3], atol=1e-3)


@pytest.mark.parametrize("first", [0, 5])
def test_a_part_of_a_sequence_takes_its_rows_of_poses_and_times(first: int, tmp_path: Path) -> None:
    """The clouds of a few sweeps with the tables of all."""
    folder = write_sequence(tmp_path / "sequences" / "04")
    clouds = sorted((folder / "velodyne").iterdir(), reverse=True)
    for index, cloud in zip((2, 1, 0), clouds):
        cloud.rename(folder / "velodyne" / f"{first + index:06d}.bin")
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, 0, 3] = STEP * np.arange(30) ** 2
    poses = T_CAMERA_LIDAR @ poses @ np.linalg.inv(T_CAMERA_LIDAR)
    (folder / "poses.txt").write_text("".join(text(pose[:3]) + "\n" for pose in poses))
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.1f}\n" for k in range(30)))
    log = KITTILog(folder)
    assert log.timestamps == [(first + k) * 10**8 for k in range(3)]
    assert np.allclose(log.poses[:, 0, 3], STEP * np.arange(first, first + 3) ** 2, atol=1e-4)


def test_a_lost_sweep_keeps_the_others_at_their_times_and_poses(tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "day" / "drive")
    (folder / "velodyne_points" / "data" / "0000000001.bin").unlink()
    log = KITTILog(folder)
    assert np.diff(log.timestamps).tolist() == [206_000_000]
    assert np.allclose(np.linalg.inv(log.poses[0]) @ log.poses[1], step_pose() @ step_pose(), atol=1e-5)


@pytest.mark.parametrize("of_camera", [False, True])
def test_kitti_360_has_its_poses_in_another_folder_by_the_numbers_of_sweeps(tmp_path: Path, of_camera: bool) -> None:
    folder = write_kitti360(tmp_path, of_camera)
    assert recognise(tmp_path) == "kitti"
    (source,) = find_sources("kitti", tmp_path)
    with pytest.warns(CFlowWarning, match="1 of 4 sweeps have no pose"):
        log: Any = open_log("kitti", source, check=False)
    assert [file.stem for file in log.files] == [f"{index:010d}" for index in (1, 2, 3)]
    assert np.allclose(log.poses[0], [[1, 0, 0, 900 + STEP], [0, 1, 0, 3700], [0, 0, 1, 110], [0, 0, 0, 1]], atol=1e-6)
    assert np.allclose(np.linalg.inv(log.poses[0]) @ log.poses[1], step_pose(), atol=1e-6)
    assert log.sweep(2).timestamp_ns == log.timestamps[2] and np.diff(log.timestamps).tolist() == [103_000_000] * 2
    (tmp_path / "calibration" / "calib_cam_to_velo.txt").unlink()
    with pytest.warns(CFlowWarning, match="data_poses.*calib_cam_to_velo.txt.*no poses"):
        assert KITTILog(folder).poses is None


def test_a_tracking_drive_is_read_in_the_frame_of_the_lidar(tmp_path: Path) -> None:
    root = write_tracking(tmp_path / "training")
    assert recognise(root) == "kitti"
    log = open_log("kitti", *find_sources("kitti", root), check=False)
    assert log.log_id == "0003" and log.sweep(1).timestamp_ns is None
    check_motion(log)
    u = 720 * 5 / 12 + 621
    assert 900 < u < 950, "a point of the wall is in a region DontCare"
    assert log.labels(0).is_valid.tolist() == [True] * 3 + [False, True, False, True]


def test_a_tracking_drive_that_lacks_sweeps_has_their_numbers_and_a_gap(tmp_path: Path) -> None:
    """As sequence 0001, which lacks sweeps 177 to 180."""
    root = write_tracking(tmp_path)
    shutil.rmtree(root / "velodyne" / "0003")
    write_clouds(root / "velodyne" / "0003", 12)
    (root / "oxts" / "0003.txt").write_text("".join(map(oxts, range(12))))
    for number in (5, 6, 7):
        (root / "velodyne" / "0003" / f"{number:06d}.bin").unlink()
    log = KITTILog(root)
    assert [log.frame_number(index) for index in range(9)] == [0, 1, 2, 3, 4, 8, 9, 10, 11]
    assert log.gaps == {4} and log.poses is not None
    assert np.allclose(log.sweep_times(0.1), 0.1 * np.array([0, 1, 2, 3, 4, 8, 9, 10, 11]))


@pytest.mark.parametrize("are_of_camera", [True, False])
def test_poses_of_a_sequence_are_of_the_camera_unless_they_drive_along_x(are_of_camera: bool, tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "sequences" / "04", are_of_camera)
    if are_of_camera:
        log = KITTILog(folder)
    else:
        with pytest.warns(CFlowWarning, match="poses of the LiDAR, and ignore Tr"):
            log = KITTILog(folder)
    assert log.log_id == "04" and log.timestamps == [0, 103_000_000, 207_000_000]
    assert np.allclose(np.linalg.inv(log.poses[0]) @ log.poses[1], step_pose(), atol=1e-9)


def test_classes_of_semantic_kitti_become_labels_and_ground(tmp_path: Path) -> None:
    log = KITTILog(write_sequence(tmp_path / "dataset" / "sequences" / "08", has_classes=True))
    moving: Any = log.moving(0)
    assert moving.tolist() == [True, True] + [False] * 5
    labels: Any = log.labels(0)
    assert labels.is_valid.tolist() == [False, False, True, True, False, True, True]
    assert (
        np.allclose(labels.flow, (-STEP, 0, 0), atol=1e-6)
        and (labels.category > 0).tolist() == [True] * 3 + [False] * 4
    )
    assert np.asarray(log.sweep(0).is_ground).tolist() == [False] * 6 + [True]
    assert log.columns(0)["instance"].tolist() == [5] * 7
    np.array([251, 9, 9, 9, 0, 9, 251], "<u4").tofile(
        tmp_path / "dataset" / "sequences" / "08" / "labels" / "000002.label"
    )
    assert log.sweep(2).is_ground is None, "these classes do not tell ground"
    assert log.moving(2).tolist() == [True] + [False] * 5 + [True]
    (tmp_path / "dataset" / "sequences" / "08" / "labels" / "000001.label").write_bytes(b"1234")
    with pytest.raises(CFlowError, match="1 labels for 7 points"):
        log.sweep(1)


def test_labels_of_some_sweeps_and_clouds_of_other_columns_are_read(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path / "sequences" / "08", has_classes=True)
    (folder / "labels" / "000001.label").unlink()
    log = KITTILog(folder)
    assert log.sweep(0).is_ground is not None and log.labels(0) is not None
    assert log.sweep(1).is_ground is None and log.labels(1) is None and log.moving(1) is None
    for file in (folder / "labels").iterdir():
        file.unlink()
    for columns, names in ((3, []), (5, ["reflectance", "column_4"])):
        for file in log.files:
            street(columns).tofile(file)
        log = KITTILog(folder)
        assert log.sweep(0).is_ground is None and list(log.columns(0)) == names and log.labels(0) is None


def test_only_points_in_the_image_of_the_drive_are_annotated(tmp_path: Path) -> None:
    folder = write_raw(tmp_path / "day" / "drive")
    whole = KITTILog(folder).labels(0).is_valid
    (folder / "image_02" / "data").mkdir(parents=True)
    Image.new("RGB", (500, 375)).save(folder / "image_02" / "data" / "0000000000.png")
    assert KITTILog(folder).labels(0).is_valid.sum() < whole.sum()


def test_drives_of_one_folder_have_distinct_names_nested_or_not(tmp_path: Path) -> None:
    for name in ("2011_09_26/2011_09_26_drive_0001_sync", "2011_09_28/2011_09_28_drive_0001_sync", "drive_9_sync"):
        write_raw(tmp_path / "raw" / name)
    for data_set in ("a", "b"):
        write_sequence(tmp_path / data_set / "sequences" / "00")
    expected = ["2011_09_26_drive_0001_sync", "2011_09_28_drive_0001_sync", "a-00", "b-00", "drive_9_sync"]
    for paths in ([tmp_path], [tmp_path / "raw", tmp_path / "a", tmp_path / "b"]):
        logs = Logs("kitti", find_all_sources("kitti", paths), {"check": False, "deskew": "off", "find_ground": None})
        assert sorted(map(source_name, logs.sources)) == expected == sorted(log.log_id for log in logs)


def test_a_folder_velodyne_of_other_clouds_is_a_folder_of_clouds(tmp_path: Path) -> None:
    write_clouds(tmp_path / "mine" / "velodyne", 3, "{:06d}")
    assert recognise(tmp_path) == "arrays"
    with pytest.raises(CFlowError, match="no drive of KITTI"):
        find_sources("kitti", tmp_path)


@pytest.mark.parametrize("layout", ["raw", "tracking", "sequence"])
def test_the_colour_cameras_project_by_the_calibration(tmp_path: Path, layout: str) -> None:
    if layout == "raw":
        log = KITTILog(write_raw(tmp_path / "2011_09_26" / "2011_09_26_drive_0027_sync"))
    elif layout == "tracking":
        log = KITTILog(write_tracking(tmp_path / "training") / "velodyne" / "0003")
    else:
        folder = write_sequence(tmp_path / "sequences" / "04")
        (folder / "calib.txt").write_text(f"P2: {text(PROJECTION)}\nTr: {text(T_CAMERA_LIDAR[:3])}\n")
        (folder / "image_2").mkdir()
        Image.new("RGB", (1226, 370)).save(folder / "image_2" / "000000.png")
        log = KITTILog(folder)
    (camera,) = log.cameras(1)  # there is no calibration of camera 3
    assert (camera.name, camera.image, camera.seconds) == ("image_02", log.files[1].stem, 0.0)
    assert camera.size == ((1242, 375) if layout == "tracking" else (1226, 370))
    points = cloud(1)[:3, :3]
    homogeneous = PROJECTION @ T_CAMERA_LIDAR @ np.column_stack([points, np.ones(3)]).T
    np.testing.assert_allclose(camera.project(camera.see(points)), (homogeneous[:2] / homogeneous[2]).T, atol=1e-6)
