"""Bags: a recording written by rosbags' own writers comes back, whatever the format, the layout and the poses."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any, Optional, Tuple

import numpy as np
import pytest
from tiny_recording import TinyRecording, rigid, turn_z

from cflow_torch import CFlowError
from cflow_torch.data.bags import BagLog
from cflow_torch.data.bags.point_cloud2 import points_and_times, seconds_after
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.log import window
from cflow_torch.data.rigid_motion import to_quaternions

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="the extra bags is not installed")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

MOUNT = rigid(turn_z(0.3) @ np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]), (1.0, 0.2, 1.7))
MAP_T_ODOM = rigid(turn_z(-0.7), (30.0, -4.0, 1.0))


class BagWriter:
    """Messages into a bag of a format: ros1, ros2 (SQLite) or mcap."""

    def __init__(self, folder: Path, form: str) -> None:
        ros1, store = form == "ros1", typesys.Stores
        self.types = typesys.get_typestore(store.ROS1_NOETIC if ros1 else store.ROS2_HUMBLE)
        if ros1:
            definition, name = "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
            self.types.register(typesys.get_types_from_msg(definition, name))
            self.bag = rosbag1.Writer(folder / "drive.bag")
        else:
            plugin = {"ros2": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}[form]
            self.bag = rosbag2.Writer(folder / "drive", version=9, storage_plugin=plugin)
        self.ros1, self.topics = ros1, {}
        self.bag.open()

    def make(self, kind: str, *fields: Any) -> Any:
        return self.types.types[kind](*fields)

    def header(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
        number = (0,) if self.ros1 else ()
        return self.make("std_msgs/msg/Header", *number, time, frame)

    def pose(self, T: np.ndarray, names: Tuple[str, str, str] = ("Point", "Quaternion", "Pose")) -> Any:
        w, x, y, z = to_quaternions(T[None, :3, :3])[0]
        kinds = [f"geometry_msgs/msg/{name}" for name in names]
        return self.make(kinds[2], self.make(kinds[0], *T[:3, 3]), self.make(kinds[1], x, y, z, w))

    def transform(self, stamp: int, parent: str, child: str, T: np.ndarray) -> Any:
        body = self.pose(T, ("Vector3", "Quaternion", "Transform"))
        return self.make("geometry_msgs/msg/TransformStamped", self.header(stamp, parent), child, body)

    def write(self, topic: str, stamp: int, kind: str, *fields: Any) -> None:
        if topic not in self.topics:
            self.topics[topic] = self.bag.add_connection(topic, kind, typestore=self.types)
        message = self.make(kind, *fields)
        serialize = self.types.serialize_ros1 if self.ros1 else self.types.serialize_cdr
        self.bag.write(self.topics[topic], stamp + 40_000_000, serialize(message, kind))  # arrives later

    def cloud(self, stamp: int, points: np.ndarray, times: Optional[np.ndarray], order: str = "<") -> Any:
        """Fields of a cloud of two rows: padded points and rows, one missing return."""
        names, kinds, offsets = ["ring", "y", "x", "z"], ["u2", "f4", "f4", "f8"], [1, 4, 8, 16]
        if times is not None:
            names, kinds, offsets = [*names, "t"], [*kinds, times.dtype.str[1:]], [*offsets, 24]
        layout = np.dtype({"names": names, "formats": [order + k for k in kinds], "offsets": offsets, "itemsize": 37})
        table = np.zeros(len(points) + len(points) % 2 + 2, layout)
        table["x"] = table["y"] = table["z"] = np.nan
        for axis, values in zip("xyz", points.T):
            table[axis][: len(points)] = values
        table["x"][-1] = table["y"][-1] = table["z"][-1] = 0
        if times is not None:
            table["t"][: len(points)] = times
        rows = np.pad(table.view(np.uint8).reshape(2, -1), ((0, 0), (0, 11)), constant_values=7)
        numbers = {"u2": 4, "u4": 6, "f4": 7, "f8": 8}
        fields = [
            self.make("sensor_msgs/msg/PointField", name, offset, numbers[kind], 1)
            for name, kind, offset in zip(names, kinds, offsets)
        ]
        shape = (2, len(table) // 2)
        header = self.header(stamp, "/velodyne" if self.ros1 else "velodyne")
        return (header, *shape, fields, order == ">", 37, rows.shape[1], rows.reshape(-1), False)


def write_bag(folder: Path, form: str, recording: TinyRecording, poses: str = "tf", order: str = "<") -> Path:
    """The first LiDAR of a recording; the second as /other with poses="two"."""
    writer = BagWriter(folder, form)
    start, end = recording.timestamps[0] - 10_000_000, recording.timestamps[-1] + 200_000_000
    link = "tf2_msgs/msg/TFMessage"
    static = [("odom", "base_link"), ("base_link", "velodyne")]
    for stamp in range(start, end, 20_000_000):
        T = np.linalg.inv(MAP_T_ODOM) @ recording.pose_at(stamp)
        if poses == "tf":
            writer.write("/tf", stamp, link, [writer.transform(stamp, *static[0], T)])
            fixed = [writer.transform(stamp, "map", "odom", MAP_T_ODOM), writer.transform(stamp, *static[1], MOUNT)]
            writer.write("/tf", stamp, link, fixed)
        elif poses == "odometry":
            covariance = np.zeros(36)
            pose = writer.make("geometry_msgs/msg/PoseWithCovariance", writer.pose(T), covariance)
            zero = writer.make("geometry_msgs/msg/Vector3", 0, 0, 0)
            twist = writer.make("geometry_msgs/msg/Twist", zero, zero)
            twist = writer.make("geometry_msgs/msg/TwistWithCovariance", twist, covariance)
            writer.write(
                "/odom", stamp, "nav_msgs/msg/Odometry", writer.header(stamp, "odom"), "base_link", pose, twist
            )
        elif poses == "pose":
            header = writer.header(stamp, "odom")
            writer.write("/pose", stamp, "geometry_msgs/msg/PoseStamped", header, writer.pose(T @ MOUNT))
    if poses == "odometry":
        writer.write("/tf_static", start, link, [writer.transform(start, *static[1], MOUNT)])
    for index, stamp in enumerate(recording.timestamps):
        units = recording.units(index)
        for unit, topic in zip(units, ("/points", "/other") if poses == "two" else ("/points",)):
            cloud = writer.cloud(stamp, unit.points, unit.offset_ns.astype(np.uint32), order)
            writer.write(topic, stamp, "sensor_msgs/msg/PointCloud2", *cloud)
    writer.bag.close()
    return folder / ("drive.bag" if form == "ros1" else "drive")


@pytest.fixture
def recording() -> TinyRecording:
    made = TinyRecording(("velodyne", "other"), num_sweeps=4)
    made.mounts["velodyne"] = MOUNT
    return made


def world_of(sweep: Any) -> np.ndarray:
    return sweep.points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]


@pytest.mark.parametrize(("form", "order"), [("ros1", "<"), ("ros2", ">"), ("mcap", "<")])
def test_a_bag_comes_back(form: str, order: str, recording: TinyRecording, tmp_path: Path) -> None:
    """Poses and the place of the LiDAR are from TF: every shot is put where it hit the world."""
    path = write_bag(tmp_path, form, recording, order=order)
    assert find_sources("bags", tmp_path) == [path] == find_sources("bags", path)
    log: Any = open_log("bags", path, check=False)
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
    raw = BagLog(path, deskew=False).sweep(1).points
    assert np.allclose(raw, recording.units(1)[0].points @ MOUNT[:3, :3].T + MOUNT[:3, 3], atol=1e-4)
    assert len(window(log, 1, num_history=1).pch) == 1 and log.labels(0) is None


@pytest.mark.parametrize("form", ["ros1", "mcap"])
@pytest.mark.parametrize(("poses", "frame"), [("odometry", "base_link"), ("pose", "velodyne")])
def test_poses_of_a_topic(form: str, poses: str, frame: str, recording: TinyRecording, tmp_path: Path) -> None:
    log = BagLog(write_bag(tmp_path, form, recording, poses))
    assert log.frame == frame
    sweep, to_map = log.sweep(3), MAP_T_ODOM
    assert np.allclose(world_of(sweep) @ to_map[:3, :3].T + to_map[:3, 3], recording.world(3)[:40], atol=5e-3)


def test_without_poses(recording: TinyRecording, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", recording, "none")
    sweep = BagLog(next(path.glob("*.mcap")), ego_T_lidar=MOUNT).sweep(0)
    assert sweep.pose is None and sweep.point_times is not None
    expected = recording.units(0)[0].points @ MOUNT[:3, :3].T + MOUNT[:3, 3]
    assert np.allclose(sweep.points, expected, atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, r"2 topics of type .*PointCloud2: choose one with topic=.*/other"),
        ({"topic": "/scan"}, "topic=/scan"),
        ({"topic": "/other", "poses": "/odom"}, "poses=/odom"),
        ({"topic": "/other", "frame": "base_link"}, "no transform leads from velodyne to base_link"),
        ({"topic": "/other", "poses": "tf"}, "fewer than two poses"),
    ],
)
def test_wrong_choices(settings: Any, message: str, recording: TinyRecording, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros2", recording, "two")
    with pytest.raises(CFlowError, match=message) as error:
        BagLog(path, **settings)
    assert str(path) in str(error.value)


def test_broken_bags(recording: TinyRecording, tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", recording)
    whole = path.read_bytes()
    for content in (b"", b"#ROSBAG V2.0\n", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(CFlowError, match="drive.bag.*whole bag"):
            BagLog(path)
    (message,) = [BagWriter(tmp_path, "ros2")]
    cloud = message.make("sensor_msgs/msg/PointCloud2", *message.cloud(0, np.ones((5, 3)), None))
    cloud.data = cloud.data[:-1]
    with pytest.raises(ValueError, match="buffer"):
        points_and_times(cloud, 0)
    cloud.fields = cloud.fields[:2]
    with pytest.raises(ValueError, match=r"lacks the fields \['x', 'z'\]"):
        points_and_times(cloud, 0)


STAMP = 1_700_000_000_123_456_789


@pytest.mark.parametrize(
    ("values", "first"),
    [
        (np.array([0, 50_000_000, 100_000_000], np.uint32), 0.0),  # Ouster: nanoseconds after the stamp
        (np.array([-0.1, -0.05, 0.0], np.float32), -0.1),  # Velodyne: seconds, up to the stamp
        (np.array([0.0, 50.0, 100.0]), 0.0),  # milliseconds
        (np.array([0, 50_000, 100_000], np.uint32), 0.0),  # microseconds
        (STAMP * 1e-9 + np.array([0.0, 0.05, 0.1]), 0.0),  # Hesai: unix seconds
        (STAMP + np.array([2_000_000, 52_000_000, 102_000_000], np.uint64), 0.002),  # unix nanoseconds
        (np.array([7e17, 7e17 + 5e7, 7e17 + 1e8]), 0.0),  # Livox without a common clock
    ],
)
def test_times_of_any_unit(values: np.ndarray, first: float) -> None:
    assert np.allclose(seconds_after(values, STAMP), first + np.array([0, 0.05, 0.1]), atol=1e-6)


def test_times_that_say_nothing() -> None:
    for values in (np.zeros(3), np.zeros(0), np.array([0.0, 1e-4]), np.array([0, 1 << 63], np.uint64)):
        assert seconds_after(values, STAMP) is None
