"""Bags: a recording written by rosbags' own writers comes back, for every format, layout and source of poses."""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_writer import MAP_T_ODOM, MOUNT, BagWriter, write_bag
from tiny_recording import TinyRecording

from cflow_torch import CFlowError
from cflow_torch.data.bags import BagLog
from cflow_torch.data.bags.messages import cloud_columns
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.deskewing import DeskewedLog
from cflow_torch.data.log import window
from cflow_torch.data.log_check import check_log, examine
from cflow_torch.transforms import to_quaternions
from cflow_torch.types import CFlowWarning


@pytest.fixture
def recording() -> TinyRecording:
    made = TinyRecording(("velodyne", "other"), num_sweeps=4)
    made.mounts["velodyne"] = MOUNT
    return made


def world_of(sweep: Any) -> np.ndarray:
    return sweep.points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]


@pytest.mark.parametrize(("form", "order"), [("ros1", "<"), ("ros2", ">"), ("mcap", "<")])
def test_a_bag_comes_back(form: str, order: str, recording: TinyRecording, tmp_path: Path) -> None:
    """Poses and the mounting of the LiDAR come from TF, so every shot returns to the point that it hit."""
    path = write_bag(tmp_path, form, recording, order=order)
    assert find_sources("bags", tmp_path) == [path] == find_sources("bags", path)
    log: Any = open_log("bags", path, deskew="times", check=False)
    assert log.log_id == "drive" and log.topic == "/points" and log.frame == "base_link"
    assert tuple(log.timestamps) == recording.timestamps
    again = pickle.loads(pickle.dumps(log))
    for index in (2, 0):
        sweep = log.sweep(index)
        assert np.allclose(sweep.pose, recording.poses[index], atol=2e-3)  # the path between poses is a chord
        assert np.allclose(world_of(sweep), recording.world(index)[:40], atol=5e-3)
        offsets = recording.units(index)[0].offset_ns * 1e-9
        assert np.allclose(sweep.point_times, offsets, atol=1e-9) and sweep.timestamp_ns == recording.timestamps[index]
        assert np.array_equal(again.sweep(index).points, sweep.points)
    columns = log.columns(0)
    assert set(columns) == {"ring", "t"} and columns["ring"].dtype == np.uint16
    assert np.array_equal(columns["t"], recording.units(0)[0].offset_ns), "those of shots without a return are left out"
    raw = BagLog(path).sweep(1).points
    assert np.allclose(raw, recording.units(1)[0].points @ MOUNT[:3, :3].T + MOUNT[:3, 3], atol=1e-4)
    assert len(window(log, 1, num_history=1).pch) == 1 and log.labels(0) is None


@pytest.mark.parametrize("form", ["ros1", "mcap"])
@pytest.mark.parametrize(("poses", "frame"), [("odometry", "base_link"), ("pose", "velodyne")])
def test_poses_come_from_a_topic(form: str, poses: str, frame: str, recording: TinyRecording, tmp_path: Path) -> None:
    log = BagLog(write_bag(tmp_path, form, recording, poses))
    assert log.frame == frame
    sweep, to_map = DeskewedLog(log, "times").sweep(3), MAP_T_ODOM
    assert np.allclose(world_of(sweep) @ to_map[:3, :3].T + to_map[:3, 3], recording.world(3)[:40], atol=5e-3)


@pytest.mark.parametrize("kind", ["Path", "TransformStamped"])
def test_poses_come_from_a_path_or_from_transforms_outside_of_tf(
    kind: str, recording: TinyRecording, tmp_path: Path
) -> None:
    writer = BagWriter(tmp_path, "ros1")
    driven: list[Any] = []
    for index, stamp in enumerate(recording.timestamps):
        T, header = recording.poses[index], writer.header(stamp, "map")
        driven.append(writer.make("geometry_msgs/msg/PoseStamped", header, writer.pose(T)))
        planned = [writer.make("geometry_msgs/msg/PoseStamped", writer.header(0, "map"), writer.pose(T))] * 2
        writer.write("/plan", stamp, "nav_msgs/msg/Path", header, planned)
        if kind == "Path":
            writer.write("/path", stamp, "nav_msgs/msg/Path", header, list(driven))
        else:
            names = ("Vector3", "Quaternion", "Transform")
            writer.write("/vicon", stamp, "geometry_msgs/msg/TransformStamped", header, "roof", writer.pose(T, names))
        cloud = writer.cloud(stamp, recording.units(index)[0].points, None)
        writer.write("/points", stamp, "sensor_msgs/msg/PointCloud2", *cloud)
    writer.bag.close()
    log: Any = BagLog(tmp_path / "drive.bag", poses="/path" if kind == "Path" else "/vicon")
    assert np.allclose(log.poses, recording.poses, atol=1e-9)


def test_a_bag_without_poses_is_read(recording: TinyRecording, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", recording, "none")
    sweep = BagLog(next(path.glob("*.mcap")), ego_T_lidar=MOUNT).sweep(0)
    assert sweep.pose is None and sweep.point_times is not None
    expected = recording.units(0)[0].points @ MOUNT[:3, :3].T + MOUNT[:3, 3]
    assert np.allclose(sweep.points, expected, atol=1e-4)


def test_poses_of_a_bag_may_lie_next_to_it(recording: TinyRecording, tmp_path: Path) -> None:
    """An odometry program wrote them, in text."""
    path = write_bag(tmp_path, "ros1", recording, "none")
    quaternions = to_quaternions(recording.poses[:, :3, :3])[:, [1, 2, 3, 0]]
    rows = np.column_stack([recording.poses[:, :3, 3], quaternions])
    lines = [f"{t // 10**9}.{t % 10**9:09d} " + " ".join(map(str, row)) for t, row in zip(recording.timestamps, rows)]
    (tmp_path / "tum.txt").write_text("\n".join(lines))
    with pytest.warns(CFlowWarning, match="its poses are those of .*tum.txt"):
        log: Any = BagLog(path)
    assert np.allclose(log.poses, recording.poses, atol=1e-6)
    (tmp_path / "tum.txt").rename(tmp_path / "other.tum")
    (tmp_path / "poses.txt").write_text("\n".join(line.split(maxsplit=1)[1] for line in lines))
    assert np.allclose(BagLog(path, poses="other.tum").poses, recording.poses, atol=1e-6)  # type: ignore[arg-type]
    with pytest.raises(CFlowError, match="has no times: give a bag poses with times"):
        BagLog(path, poses="poses.txt")


def test_missing_times_of_points_are_on_the_page(recording: TinyRecording, tmp_path: Path) -> None:
    """They are no mistake: many clouds are compensated already."""
    path = write_bag(tmp_path, "ros1", recording)
    with open_log("bags", path, deskew="off") as log:
        page = {finding.topic: finding.text for finding in examine(log)}
    assert page["de-skewing"] == "as you say, deskew=off"
    path.write_bytes(path.read_bytes().replace(b"\x01\x00\x00\x00t", b"\x01\x00\x00\x00u"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", CFlowWarning)
        with BagLog(path) as log:
            check_log(log)
    with open_log("bags", path) as log:
        page = {finding.topic: finding.text for finding in examine(log)}
    assert "no times of points" in page["de-skewing"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, r"2 topics of type .*PointCloud2.*data.topic=NAME.*/other"),
        ({"topic": "/scan"}, "topic=/scan"),
        ({"topic": "/other", "poses": "/odom"}, "poses=/odom"),
        ({"topic": "/other", "frame": "base_link"}, "no transforms connect velodyne to base_link"),
        ({"topic": "/other", "poses": "tf"}, "fewer than two poses"),
    ],
)
def test_wrong_topics_are_refused(settings: Any, message: str, recording: TinyRecording, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros2", recording, "two")
    with pytest.raises(CFlowError, match=message) as error:
        BagLog(path, **settings)
    assert str(path) in str(error.value)


def test_broken_bags_are_refused(recording: TinyRecording, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", recording)
    whole = path.read_bytes()
    pointer = b"version https://git-lfs.github.com/spec/v1\n"
    for content in (b"", b"#ROSBAG V2.0\n", whole[: len(whole) // 2], pointer):
        path.write_bytes(content)
        with pytest.raises(CFlowError, match="drive.bag.*" + ("git-lfs" if content == pointer else "complete bag")):
            BagLog(path)
    (message,) = [BagWriter(tmp_path, "ros2")]
    cloud = message.make("sensor_msgs/msg/PointCloud2", *message.cloud(0, np.ones((5, 3)), None))
    cloud.data = cloud.data[:-1]
    with pytest.raises(ValueError, match="buffer"):
        cloud_columns(cloud)
    cloud.fields = cloud.fields[:2]
    with pytest.raises(ValueError, match=r"lacks the fields \['x', 'z'\]"):
        cloud_columns(cloud)
