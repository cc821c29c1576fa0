"""Folders of point clouds: every suffix, every pose format, and what goes wrong with them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import feather, parquet

from cflow_torch import CFlowError, Sweep, estimate_flow
from cflow_torch.data.arrays.cloud_file import SUFFIXES, read_cloud, write_cloud
from cflow_torch.data.arrays.ply import read_ply, write_ply
from cflow_torch.data.arrays.poses_text import (
    Trajectory,
    poses_at,
    read_poses,
    read_times,
    write_kitti_poses,
    write_times,
    write_tum_poses,
)
from cflow_torch.data.arrays.reader import ArraysLog, find_array_logs, natural_key
from cflow_torch.data.arrays.writer import write_array_log
from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive

STAMP = 1_700_000_000_123_456_789


class SmallLog:
    """Three sweeps of 40 points with full poses (yaw, pitch, roll)."""

    log_id = "small"

    def __init__(self, poses=True, times=True, ground=True) -> None:
        rng = np.random.default_rng(3)
        self.timestamps = [STAMP + k * 100_000_000 for k in range(3)]
        self.poses = np.stack([scenes.pose(3.0 * k, -k, 0.3 * k) @ tilt(0.1, 0.2 * k) for k in range(3)])
        self.sweeps = [
            Sweep(
                rng.normal(0, 30, (40, 3)).astype(np.float32),
                rng.random(40) < 0.4 if ground else None,
                pose if poses else None,
                time if times else None,
            )
            for pose, time in zip(self.poses, self.timestamps)
        ]

    def sweep(self, index: int) -> Sweep:
        return self.sweeps[index]

    def labels(self, index: int) -> None:
        return None


def tilt(roll: float, pitch: float) -> np.ndarray:
    a, b = np.eye(4), np.eye(4)
    a[1:3, 1:3] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    b[0:3:2, 0:3:2] = [[np.cos(pitch), np.sin(pitch)], [-np.sin(pitch), np.cos(pitch)]]
    return a @ b


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_simulated_drive_comes_back_from_every_suffix(tmp_path, suffix):
    drive = make_drive(seed=1, num_sweeps=2, profile="demo")
    log = ArraysLog(write_array_log(drive, tmp_path, suffix))
    assert log.log_id == drive.log_id and list(log.timestamps) == list(drive.timestamps) and len(log) == 2
    for index in range(2):
        stored, read = drive.sweep(index), log.sweep(index)
        assert read.points.dtype == np.float32 and np.array_equal(read.points, stored.points), "float32, every bit"
        assert np.array_equal(read.pose, stored.pose), "17 digits keep every bit"
        assert np.array_equal(read.is_ground, stored.is_ground) and read.timestamp_ns == stored.timestamp_ns
        assert log.labels(index) is None


@pytest.mark.parametrize("poses", ["kitti", "tum", "npy", None])
def test_pose_formats(tmp_path, poses):
    small = SmallLog()
    log = ArraysLog(write_array_log(small, tmp_path, poses=poses))
    assert list(log.timestamps) == small.timestamps, "unix time to the nanosecond"
    if poses is None:
        assert log.poses is None and log.sweep(0).pose is None
    else:
        assert np.abs(log.poses - small.poses).max() < (1e-14 if poses == "tum" else 1e-300)


def test_what_a_log_lacks_is_not_written(tmp_path):
    folder = write_array_log(SmallLog(poses=False, times=False, ground=False), tmp_path, poses=None)
    assert [path.name for path in folder.iterdir()] == ["points"]
    log = ArraysLog(folder)
    assert list(log.timestamps) == [0, 1, 2] and log.sweep(1).timestamp_ns is None and log.sweep(1).is_ground is None
    with pytest.raises(CFlowError, match="poses=None"):
        write_array_log(SmallLog(poses=False), tmp_path / "b")
    with pytest.raises(CFlowError, match="exists already"):
        write_array_log(SmallLog(), tmp_path)
    assert not list((tmp_path / "b").iterdir()), "nothing half-written"


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_cloud_files(tmp_path, suffix, dtype):
    points = np.random.default_rng(0).normal(0, 50, (30, 3)).astype(dtype)
    points[3] = np.nan
    for name, intensity in (("a", None), ("b", np.linspace(0, 1, 30))):
        file = tmp_path / f"{name}{suffix}"
        write_cloud(file, points, intensity)
        read = read_cloud(file)
        expected = points.astype(np.float32) if suffix == ".bin" else points
        assert read.dtype == expected.dtype and np.array_equal(read, expected, equal_nan=True)
    write_cloud(file, points[:0])
    assert read_cloud(file).shape == (0, 3)


def test_columns_by_name_or_by_place(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3)).astype(np.float32)
    x, y, z = points.T
    structured = np.zeros(20, [("intensity", "u1"), ("z", "f4"), ("x", "f4"), ("y", "f4")])
    structured["x"], structured["y"], structured["z"] = x, y, z
    np.save(tmp_path / "structured.npy", structured)
    np.save(tmp_path / "wide.npy", np.asfortranarray(np.concatenate([points, points], 1)))
    np.savez(tmp_path / "axes.npz", x=x, y=y, z=z, ring=np.zeros(20, int))
    np.savez(tmp_path / "one.npz", cloud=points, ring=np.zeros(20, int))
    np.savez(tmp_path / "named.npz", other=np.zeros((9, 4)), lidar=points)
    feather.write_feather(pa.table({"i": [0.5] * 20, "y": y, "x": x, "z": z}), str(tmp_path / "named.feather"))
    parquet.write_table(pa.table({"east": x, "north": y, "up": z, "i": y}), str(tmp_path / "first.parquet"))
    np.save(tmp_path / "swapped.npy", points.astype(">f4"))
    points5 = np.concatenate([points, points[:, :2]], 1)
    (tmp_path / "nuscenes.bin").write_bytes(points5.tobytes())
    for file in sorted(tmp_path.iterdir()):
        assert np.array_equal(read_cloud(file, 5), points), file.name


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_broken_cloud_files(tmp_path, suffix):
    file = tmp_path / f"cloud{suffix}"
    write_cloud(file, np.ones((50, 3), np.float32))
    whole = file.read_bytes()
    for content in (whole[: len(whole) // 2 + 1], whole[:5], b"\x00\xff not a cloud"):
        file.write_bytes(content)
        with pytest.raises(CFlowError, match="cloud"):
            read_cloud(file)
    with pytest.raises(CFlowError, match="does not exist"):
        read_cloud(tmp_path / f"missing{suffix}")


def test_files_that_hold_something_else(tmp_path):
    np.save(tmp_path / "flat.npy", np.zeros(9))
    np.save(tmp_path / "whole.npy", np.zeros((9, 3), np.int32))
    np.save(tmp_path / "pickle.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    np.savez(tmp_path / "two.npz", a=np.zeros((3, 3)), b=np.zeros((3, 3)))
    np.savez(tmp_path / "ragged.npz", x=np.zeros(3), y=np.zeros(2), z=np.zeros(3))
    feather.write_feather(pa.table({"x": [1.0], "y": [1.0]}), str(tmp_path / "narrow.feather"))
    parquet.write_table(pa.table({"x": [1.0, None], "y": [1.0, 1], "z": [1.0, 1]}), str(tmp_path / "holes.parquet"))
    write_ply(tmp_path / "flat.ply", {"x": np.zeros(3, np.float32), "y": np.zeros(3, np.float32)})
    (tmp_path / "cloud.las").write_bytes(b"LASF")
    for file in sorted(tmp_path.iterdir()):
        with pytest.raises(CFlowError, match=file.name):
            read_cloud(file)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(0, 20),
    st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]),
    st.lists(st.sampled_from(["f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4"]), min_size=1, max_size=4),
    st.integers(0, 10**6),
)
def test_ply_round_trip(tmp_path_factory, rows, data, kinds, seed):
    rng = np.random.default_rng(seed)
    fields = {
        f"p{k}": rng.integers(0, 256, (rows, int(kind[1])), np.uint8).view(kind)[:, 0] for k, kind in enumerate(kinds)
    }
    file = tmp_path_factory.mktemp("ply") / "a.ply"
    write_ply(file, fields, data)
    again = read_ply(file)
    assert list(again) == list(fields)
    for name, values in fields.items():
        assert again[name].dtype == values.dtype
        assert np.array_equal(again[name], values, equal_nan=values.dtype.kind == "f")


def test_ply_of_other_programs(tmp_path):
    text = (
        "ply\nformat ascii 1.0\ncomment by hand\nobj_info nothing\nelement vertex 2\nproperty float32 x\n"
        "property double y\nproperty uint8 red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "1.5 -2 255\n0 1e-3 7\n3 0 1 1\n"
    )
    (tmp_path / "a.ply").write_text(text)
    cloud = read_ply(tmp_path / "a.ply")
    assert cloud["x"].tolist() == [1.5, 0] and cloud["y"].tolist() == [-2, 1e-3] and cloud["red"].tolist() == [255, 7]
    for old, new in (
        ("1.5 -2 255", "1.5 -2 256"),
        ("float32 x", "list uchar int x"),
        ("element vertex 2", "element vertex 9"),
        ("element vertex 2", "element points 2"),
        ("format ascii 1.0", "format zip 1.0"),
        ("end_header", ""),
        ("ply\n", ""),
        ("double y", "double x"),
    ):
        (tmp_path / "a.ply").write_text(text.replace(old, new, 1))
        with pytest.raises(CFlowError, match=r"a\.ply"):
            read_ply(tmp_path / "a.ply")


def test_natural_order(tmp_path):
    names = ["10", "9", "a2", "a10", "a1b", "a1", "007", "7"]
    assert sorted(names, key=natural_key) == ["007", "7", "9", "10", "a1", "a1b", "a2", "a10"]
    for k in (1, 2, 10):
        np.save(tmp_path / f"frame{k}.npy", np.full((4, 3), float(k)))
    assert [ArraysLog(tmp_path).sweep(i).points[0, 0] for i in range(3)] == [1, 2, 10]


def test_times_from_names_poses_and_files(tmp_path):
    for place, factor in (("ns", 1), ("us", 1000)):
        (tmp_path / place).mkdir()
        for k in range(2):
            np.save(tmp_path / place / f"{(1_700_000_000_000_000_000 + k * 10**8) // factor}.npy", np.zeros((4, 3)))
        log = ArraysLog(tmp_path / place)
        assert log.sweep(1).timestamp_ns == log.timestamps[1] == 1_700_000_000_100_000_000
    folder = write_array_log(SmallLog(), tmp_path, poses="tum")
    (folder / "times.txt").unlink()
    assert list(ArraysLog(folder).timestamps) == SmallLog().timestamps, "from the poses"
    assert list(ArraysLog(folder, poses=None).timestamps) == [0, 1, 2]


def test_poses_at_a_rate_of_their_own(tmp_path):
    """A trajectory at 50 Hz: constant speed and turn rate are met between its poses."""
    folder = write_array_log(SmallLog(), tmp_path, poses=None)
    seconds = np.arange(-1, 14) * 0.02
    truth = [scenes.pose(10 * s, 0, 0.5 * s) for s in seconds]
    times = [STAMP + 7_000_000 + round(s * 1e9) for s in seconds]
    write_tum_poses(folder / "poses.txt", times, np.stack(truth))
    log = ArraysLog(folder)
    for k, pose in enumerate(log.poses):
        at = 0.1 * k - 0.007
        assert np.abs(pose - scenes.pose(10 * at, 0, 0.5 * at)).max() < 1e-12
    write_times(folder / "times.txt", [time + 10**12 for time in SmallLog().timestamps])
    with pytest.raises(CFlowError, match="same moment"):
        ArraysLog(folder)
    gap = Trajectory(np.stack([np.eye(4)] * 2), np.array([0, 10**9]), "tum")
    assert np.array_equal(poses_at(gap, [0, 10**9], "x"), gap.poses)
    with pytest.raises(CFlowError, match="no pose near"):
        poses_at(gap, [5 * 10**8], "x")


def test_kitti_calibration(tmp_path):
    """Camera poses and Tr give the LiDAR's motion: inv(Tr) P Tr."""
    folder = write_array_log(SmallLog(), tmp_path)
    camera_T_lidar = np.array([[0, -1, 0, 0.1], [0, 0, -1, -0.2], [1, 0, 0, -0.3], [0, 0, 0, 1.0]])
    lidar = np.stack([scenes.pose(k, 0.1 * k, 0.05 * k) for k in range(3)])
    write_kitti_poses(folder / "poses.txt", camera_T_lidar @ lidar @ np.linalg.inv(camera_T_lidar))
    row = " ".join(f"{v:.12e}" for v in camera_T_lidar[:3].ravel())
    (folder / "calib.txt").write_text(f"P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: {row}\n")
    assert np.abs(ArraysLog(folder).poses - lidar).max() < 1e-12
    assert np.abs(ArraysLog(folder, calibration=None).poses[1] - lidar[1]).max() > 0.5
    # With the LiDAR's place in the ego frame: the points are moved, the poses are those of the ego frame.
    ego_T_lidar = scenes.pose(1.3, 0.2, 0.4, 1.6)
    moved = ArraysLog(folder, ego_T_lidar=ego_T_lidar)
    sweep, plain = moved.sweep(2), ArraysLog(folder).sweep(2)
    one = np.ones((40, 1))
    world = np.concatenate([plain.points, one], 1) @ plain.pose.T
    assert np.abs(np.concatenate([sweep.points, one], 1) @ sweep.pose.T - world).max() < 1e-4
    assert np.abs(sweep.points - plain.points).max() > 1
    # KITTI's own tree: dataset/sequences/00/velodyne and dataset/poses/00.txt.
    tree = tmp_path / "kitti" / "sequences" / "00"
    tree.mkdir(parents=True)
    (folder / "points").rename(tree / "velodyne")
    (folder / "calib.txt").rename(tree / "calib.txt")
    (tmp_path / "kitti" / "poses").mkdir()
    (folder / "poses.txt").rename(tmp_path / "kitti" / "poses" / "00.txt")
    assert find_array_logs(tmp_path / "kitti") == [tree]
    assert np.abs(ArraysLog(tree).poses - lidar).max() < 1e-12
    (tree / "calib.txt").write_text("P0: 1 0\n")
    with pytest.raises(CFlowError, match="Tr"):
        ArraysLog(tree)


def test_whose_poses(tmp_path):
    folder = write_array_log(SmallLog(), tmp_path)
    ego_T_lidar = scenes.pose(1.3, 0.2, 0.4, 1.6)
    ego, lidar = (ArraysLog(folder, ego_T_lidar=ego_T_lidar, poses_of=of) for of in ("ego", "lidar"))
    assert np.array_equal(ego.poses, SmallLog().poses)
    assert np.abs(lidar.poses @ ego_T_lidar - SmallLog().poses).max() < 1e-12
    with pytest.raises(CFlowError, match="poses_of"):
        ArraysLog(folder, poses_of="camera")


def test_logs_are_found(tmp_path):
    for name in ("b", "a/x", "a/y"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_array_log(SmallLog(), tmp_path / name)
    (tmp_path / "empty").mkdir()
    assert find_array_logs(tmp_path) == [tmp_path / p for p in ("a/x/small", "a/y/small", "b/small")]
    assert find_array_logs(tmp_path / "b" / "small") == [tmp_path / "b" / "small"]
    assert find_array_logs(tmp_path / "empty") == []
    with pytest.raises(CFlowError, match="no folder"):
        find_array_logs(tmp_path / "nowhere")


def edit(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text)


@pytest.mark.parametrize(
    ("damage", "settings_", "complaint"),
    [
        (lambda f: edit(f, "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n"), {}, "1 poses for 3 sweeps"),
        (lambda f: edit(f, "poses.txt", "1 2 3\n"), {}, "numbers a line"),
        (lambda f: edit(f, "poses.txt", "2 0 0 0 0 1 0 0 0 0 1 0\n" * 3), {}, "not rigid"),
        (lambda f: edit(f, "poses.txt", "0 0 0 0 0 0 0 2\n"), {}, "length 2"),
        (lambda f: edit(f, "poses.txt", "1 0 0 0 0 0 0 1\n0 0 0 0 0 0 0 1\n"), {}, "ascend"),
        (lambda f: edit(f, "poses.txt", "nan 0 0 0 0 0 0 1\n"), {}, "finite numbers"),
        (lambda f: edit(f, "poses.txt", "# nothing\n"), {}, "is empty"),
        (lambda f: edit(f, "times.txt", "1.0\n2.0\n"), {}, "2 times for 3"),
        (lambda f: np.save(f / "poses.npy", np.eye(4)), {}, "several"),
        (lambda f: np.save(f / "poses.npy", np.eye(4)), {"poses": "poses.npy"}, "shape"),
        (lambda f: None, {"poses": "gone.txt"}, "names nothing"),
        (lambda f: None, {"poses": np.eye(4)}, "shape"),
        (lambda f: None, {"suffix": ".pcd"}, "fewer than two"),
        (lambda f: None, {"ego_T_lidar": np.ones((4, 4))}, "ego_T_lidar"),
        (lambda f: [write_cloud(f / "points" / f"{k}.ply", np.ones((1, 3))) for k in "ab"], {}, "several kinds"),
    ],
)
def test_a_log_that_does_not_fit(tmp_path, damage, settings_, complaint):
    folder = write_array_log(SmallLog(), tmp_path)
    damage(folder)
    with pytest.raises(CFlowError, match=complaint):
        ArraysLog(folder, **settings_)


def test_a_sweep_that_does_not_fit(tmp_path):
    folder = write_array_log(SmallLog(), tmp_path)
    log = ArraysLog(folder)
    for mask in (np.zeros(39, bool), np.zeros(40), np.full(40, 2)):
        np.save(folder / "ground" / "000001.npy", mask)
        with pytest.raises(CFlowError, match=r"000001\.npy"):
            log.sweep(1)
    (folder / "ground" / "000001.npy").unlink()
    with pytest.raises(CFlowError, match="ground=None"):
        log.sweep(1)
    assert ArraysLog(folder, ground=None).sweep(1).is_ground is None
    for index in (-1, 3):
        with pytest.raises(CFlowError, match="sweeps 0"):
            log.sweep(index)


def test_times_keep_their_nanoseconds(tmp_path):
    stamps = [-1_500_000_001, 0, 5, 1_700_000_000_123_456_789]
    write_times(tmp_path / "t.txt", stamps)
    assert read_times(tmp_path / "t.txt").tolist() == stamps
    (tmp_path / "m.txt").write_text("1, 0, 0, 5, 0,1,0,6, 0,0,1,7, 0,0,0,1\n")
    assert read_poses(tmp_path / "m.txt").poses[0, :3, 3].tolist() == [5, 6, 7], "16 numbers, commas"


def test_from_files_to_flow(tmp_path):
    """The whole way of a stranger's data: clouds, poses, masks in a folder; the drive itself gives the same bits."""
    drive = make_drive(seed=2, num_sweeps=3, profile="demo")
    results = []
    for log in (drive, ArraysLog(write_array_log(drive, tmp_path, ".ply"))):
        pair = window(log, 1, 1)
        assert len(pair.pch) == 1
        results.append(
            estimate_flow(
                pair.pc0.points,
                pair.pc1.points,
                T_ego1_ego0=np.linalg.inv(pair.pc1.pose) @ pair.pc0.pose,
                gm0=pair.pc0.is_ground,
                gm1=pair.pc1.is_ground,
                preset="fast",
            )
        )
    scenes.assert_same(*results)
    assert (results[0].cluster_id >= 0).any()
