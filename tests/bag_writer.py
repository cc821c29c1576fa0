"""Write ROS bags with `rosbags`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_recording import TinyRecording, rigid, turn_z

from cflow_torch.transforms import to_quaternions

rosbag1 = pytest.importorskip("rosbags.rosbag1", reason="the extra bags is not installed")
rosbag2 = pytest.importorskip("rosbags.rosbag2")
typesys = pytest.importorskip("rosbags.typesys")

MOUNT = rigid(turn_z(0.3) @ np.array([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]), (1.0, 0.2, 1.7))
MAP_T_ODOM = rigid(turn_z(-0.7), (30.0, -4.0, 1.0))


class BagWriter:
    """Write messages into a bag of a format: ros1, ros2 (SQLite) or mcap."""

    def __init__(self, folder: Path, form: str) -> None:
        ros1, store = form == "ros1", typesys.Stores
        self.types = typesys.get_typestore(store.ROS1_NOETIC if ros1 else store.ROS2_HUMBLE)
        if ros1:
            definition, name = "geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"
            self.types.register(typesys.get_types_from_msg(definition, name))
            self.bag = rosbag1.Writer(folder / "drive.bag")
        elif hasattr(rosbag2, "StoragePlugin"):
            plugin = {"ros2": rosbag2.StoragePlugin.SQLITE3, "mcap": rosbag2.StoragePlugin.MCAP}[form]
            self.bag = rosbag2.Writer(folder / "drive", version=9, storage_plugin=plugin)
        elif form == "ros2":  # rosbags of Python 3.8
            self.bag = rosbag2.Writer(folder / "drive")
        else:
            pytest.skip("this version of rosbags does not write MCAP")
        self.ros1, self.topics = ros1, {}
        self.bag.open()

    def make(self, kind: str, *fields: Any) -> Any:
        return self.types.types[kind](*fields)

    def header(self, stamp: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", *divmod(stamp, 1_000_000_000))
        number = (0,) if self.ros1 else ()
        return self.make("std_msgs/msg/Header", *number, time, frame)

    def pose(self, T: np.ndarray, names: tuple[str, str, str] = ("Point", "Quaternion", "Pose")) -> Any:
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

    def cloud(self, stamp: int, points: np.ndarray, times: np.ndarray | None, order: str = "<") -> Any:
        """Return the fields of a cloud of two rows, with padded points and rows and one missing return."""
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
    """Write the first LiDAR of a recording; with poses="two" also the second, as /other."""
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
