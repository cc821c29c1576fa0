"""An example node for ROS 2: estimate the flow of a PointCloud2 topic as it arrives. Needs a sourced ROS 2.

    python scripts/ros2_flow_node.py --ros-args -p cloud:=/points -p odometry:=/odom -p preset:=paper

The node publishes <cloud>/flow: the points of the sweep before, with vx, vy, vz over ground (m/s) and their object id,
in the axes of the newest sweep. It logs its latency. Clouds and odometry must both be in the frame of the vehicle, or
both in that of the sensor. The node uses the pose nearest in time. Without an odometry topic, KISS-ICP estimates poses
(extra `odometry`). Nobody has run the node on a robot yet.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import rclpy
import torch
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2, PointField
from sensor_msgs_py.point_cloud2 import create_cloud, read_points_numpy

from cflow_torch import CFlowError, FlowStream
from cflow_torch.transforms import poses_from_quaternions

_NAMES = ("x", "y", "z", "vx", "vy", "vz", "object")
_FIELDS = [PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate(_NAMES)]


class FlowNode(Node):  # type: ignore[misc]
    """One `FlowStream` between two topics."""

    def __init__(self) -> None:
        super().__init__("cflow")
        names: dict[str, str] = {
            name: self.declare_parameter(name, default).value
            for name, default in {"cloud": "/points", "odometry": "", "preset": "default", "ground": "auto"}.items()
        }
        self._stream = FlowStream(names["preset"], ground=names["ground"] or None)
        self._poses: dict[int, np.ndarray] | None = {} if names["odometry"] else None
        self._publisher = self.create_publisher(PointCloud2, f"{names['cloud']}/flow", 1)
        self.create_subscription(PointCloud2, names["cloud"], self.on_cloud, qos_profile_sensor_data)
        if names["odometry"]:
            self.create_subscription(Odometry, names["odometry"], self.on_odometry, 50)

    def on_odometry(self, message: Any) -> None:
        """Store a pose; keep the last hundred."""
        pose, stamp = message.pose.pose, message.header.stamp
        rotation = (pose.orientation.w, pose.orientation.x, pose.orientation.y, pose.orientation.z)
        position = (pose.position.x, pose.position.y, pose.position.z)
        (self._poses[_nanoseconds(stamp)],) = poses_from_quaternions([position], [rotation], lambda _: "a pose")
        while len(self._poses) > 100:
            del self._poses[min(self._poses)]

    def on_cloud(self, message: Any) -> None:
        """Push a sweep, and publish the flow of the one before it."""
        begin, stamp, pose = time.perf_counter(), _nanoseconds(message.header.stamp), None
        if self._poses is not None:
            if not self._poses:
                return
            pose = self._poses[min(self._poses, key=lambda known: abs(known - stamp))]
        points = read_points_numpy(message, field_names=["x", "y", "z"])
        try:
            result = self._stream.push(points, pose, stamp)
        except CFlowError as error:
            self.get_logger().warning(str(error))
            return
        if result is None:
            return
        before = self._stream.window.pc0
        seconds = (stamp - before.timestamp_ns) / 1e9
        moved = torch.as_tensor(before.points, dtype=torch.float32) + result.flow.cpu()
        ids = result.cluster_id.cpu()[:, None].float()
        rows = torch.cat((moved, result.residual_flow.cpu() / seconds, ids), 1)[result.is_valid.cpu()]
        self._publisher.publish(create_cloud(message.header, _FIELDS, rows.numpy()))
        self.get_logger().info(f"{1000 * (time.perf_counter() - begin):.0f} ms", throttle_duration_sec=1.0)


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def main() -> None:
    rclpy.init()
    node = FlowNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
