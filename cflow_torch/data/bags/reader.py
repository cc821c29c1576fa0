"""Experimental reader of ROS 1, ROS 2 and MCAP bags, by rosbags (extra `bags`)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from cflow_torch.data.arrays.poses_text import Trajectory, covered_poses
from cflow_torch.data.bags.messages import Frames, cloud_columns, sample, sorted_poses
from cflow_torch.data.files import file_errors, find_folders, shortened
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path, check_file, is_remote
from cflow_torch.data.point_times import TIME_FIELDS, seconds_after
from cflow_torch.data.rigid_motion import poses_at, transform_each, transform_points
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.types import Sweep
from cflow_torch.windows.ego_motion import rigid_transform

SUFFIXES = (".bag", ".mcap", ".db3")
SEARCH_DEPTH = 3
_CLOUD = "sensor_msgs/msg/PointCloud2"
_POSE_TYPES = ("nav_msgs/msg/Odometry", *(f"geometry_msgs/msg/Pose{name}Stamped" for name in ("", "WithCovariance")))
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_NEED = "bags need rosbags: pip install rosbags"
_BASE = "base_link"  # the vehicle, by ROS's REP 105: x forward, y left, z up
_SLICE = 1e-4  # seconds during which we use one pose of the vehicle: 3 mm at 30 m/s


def find_bags(root: PathLike) -> list[Path]:
    """Find all bags in a folder, at most three levels down, sorted; or return the given bag.

    Bags are files `.bag` (ROS 1), `.mcap`, `.db3`, and folders with a metadata.yaml (ROS 2).
    """
    root = as_path(root)
    if root.is_file():
        return [root]
    folders = find_folders(root, lambda folder: bool(_bags_in(folder)), SEARCH_DEPTH, "a bag, or a folder of bags")
    return sorted(bag for folder in folders for bag in _bags_in(folder))


class BagLog(Log):
    """One bag. Experimental: tested on bags that rosbags wrote, never on a recorded one.

    Args:
        path: a file, or the folder of a ROS 2 bag, on this machine.
        topic: topic of the clouds (sensor_msgs/PointCloud2); None = the only one of this type.
        poses: "tf" = from the transforms; a topic of nav_msgs/Odometry, geometry_msgs/PoseStamped or
            PoseWithCovarianceStamped; None = no poses; "auto" = the first available of: transforms in which the ego
            frame moves, the only topic of these types, none.
        frame: name of the ego frame; None = base_link if transforms connect it to the LiDAR, else the LiDAR's own.
        ego_T_lidar: (4, 4), maps the frame of the clouds to the ego frame; None = from the transforms.
        deskew: transform each point by the pose of the vehicle at the time of the point, if poses and times of points
            are known; False = the clouds are already de-skewed.

    Attributes:
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep; None = unknown.
        timestamps: nanoseconds from the header of each cloud (if that is 0, from its arrival). Clouds before the first
            or after the last pose are left out.
        topic, frame, deskew: the settings in use.

    Convention: points are in the ego frame. Poses are interpolated at the time of the cloud. The world is the root of
        the transforms, or the world of the topic. A topic gives the poses of its `child_frame_id` if transforms connect
        this frame to the ego frame, otherwise the poses of the ego frame. Times of points: `point_times.seconds_after`.

    Cost: opening a bag reads all its clouds, poses and transforms once.
    """

    def __init__(
        self,
        path: PathLike,
        topic: str | None = None,
        poses: str | None = "auto",
        frame: str | None = None,
        ego_T_lidar: Any = None,
        deskew: bool = True,
    ) -> None:
        self.path = as_path(path)
        if is_remote(self.path):
            raise CFlowError(f"{self.path} is remote: bags are read from this machine only; copy it here")
        self.log_id = self.path.resolve().stem if self.path.is_file() else self.path.resolve().name
        self.deskew = deskew
        self.poses: np.ndarray | None = None
        self._opened: tuple[int, Any] = (0, None)
        self._mount = None if ego_T_lidar is None else rigid_transform(ego_T_lidar, "ego_T_lidar")
        with file_errors(f"{self.path}", "is it a complete bag of ROS 1 (.bag), ROS 2 (folder) or MCAP?"):
            topics = {connection.topic: connection.msgtype for connection in self._reader().connections}
            self.topic = self._chosen(topics, (_CLOUD,), topic, "topic")
            self._arrival, tracks = self._scan()
            self.frame = frame or (_BASE if self._frames.are_joined(_BASE, self._lidar) else self._lidar)
            if poses == "auto":
                has_tf = len(self._frames.change_times(self.frame)) > 1
                poses = "tf" if has_tf else self._chosen(topics, _POSE_TYPES, None, "poses") if tracks else None
            elif poses not in (None, "tf"):
                poses = self._chosen(topics, _POSE_TYPES, poses, "poses")
            self.timestamps = sorted(self._arrival)
            if poses is not None:
                self._odometry = times, matrices = self._trajectory(poses, tracks)
                self.timestamps = [time for time in self.timestamps if times[0] <= time <= times[-1]]
            self._check_count(f"{self.path}: {self.topic}, while there are poses,")
            if poses is not None:
                self.poses = covered_poses(Trajectory(matrices, times, "bag", poses), self.timestamps)
            self._period = float(np.median(np.diff(self.timestamps))) * 1e-9
            if self._mount is None:
                self._frames.between(self.frame, self._lidar, np.array(self.timestamps[:1]))

    def sweep(self, index: int) -> Sweep:
        time = self._timestamp(index)
        columns, times = self._timed_cloud(time)
        mount = self._mount
        if mount is None:
            mount = self._frames.between(self.frame, self._lidar, np.array([time]))[0]
        points = transform_points(_points(columns), mount)
        if self.poses is None:
            return Sweep(points.astype(np.float32), None, None, time, times)
        if times is not None and self.deskew:
            shots, group = np.unique(np.round(times / _SLICE).astype(np.int64), return_inverse=True)
            at = poses_at(time + shots * round(_SLICE * 1e9), *self._odometry)
            points = transform_each(points, (np.linalg.inv(self.poses[index]) @ at)[group])
        return Sweep(points.astype(np.float32), None, self.poses[index].copy(), time, times)

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read the fields besides x, y, z, such as intensity and ring, of the points of sweep `index`."""
        columns, _ = self._timed_cloud(self._timestamp(index))
        return {name: values for name, values in columns.items() if name not in ("x", "y", "z")}

    def _timed_cloud(self, time: int) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Read a cloud and the (N,) seconds of its points; None = unknown. We leave out points of stray times."""
        columns = self._cloud(time)
        points, names = _points(columns), [name for name in TIME_FIELDS if name in columns]
        found = [seconds_after(columns[name], time, self._period, points) for name in names]
        usable = [times for times in found if times.seconds is not None]
        for times in usable[:1] or found:
            self._note(times.note, "times of points")
        if not usable or usable[0].seconds is None:
            return columns, None
        kept = ~usable[0].is_stray
        if not kept.all():
            text = f"{(~kept).sum()} of {len(kept)} points of the sweep at {time} ns have stray times and are left out"
            self._note(text + ", also in other sweeps", "stray times")
        return {name: values[kept] for name, values in columns.items()}, usable[0].seconds[kept]

    def _reader(self) -> Any:
        """Return the open bag. Each process opens it itself, also after a fork or unpickling."""
        if self._opened[0] != os.getpid():
            rosbags, types = (import_optional(f"rosbags.{name}", _NEED) for name in ("highlevel", "typesys"))
            for file in [self.path] if self.path.is_file() else self.path.iterdir():
                check_file(file)
            # Bags of ROS 2 before Iron do not describe their messages. The types that we read never changed.
            types_of_old_bags = types.get_typestore(types.Stores.ROS2_HUMBLE)
            reader = rosbags.AnyReader([self.path], default_typestore=types_of_old_bags)
            reader.open()
            self._opened = (os.getpid(), reader)
        return self._opened[1]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": (0, None)}

    def _chosen(self, topics: dict[str, str], types: tuple[str, ...], name: str | None, setting: str) -> str:
        """Return the topic with this name and one of these types; without a name, the only topic of these types."""
        found = sorted(topic for topic, kind in topics.items() if kind in types and name in (None, topic))
        if len(found) != 1:
            available = shortened(", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())))
            what = f"{setting}={name}" if name else f"{len(found)} topics"
            raise CFlowError(
                f"{what} of type {' or '.join(types)}: choose one with {setting}=NAME, "
                f"in commands data.{setting}=NAME; the bag has {available}"
            )
        return found[0]

    def _scan(self) -> tuple[dict[int, int], dict[str, list[Any]]]:
        """Read all messages once. Return the arrival time of each cloud and the pose samples of each topic."""
        self._lidar = ""
        self._child: dict[str, str] = {}
        arrival: dict[int, int] = {}
        parents: dict[str, str] = {}
        links: dict[str, list[Any]] = {}
        tracks: dict[str, list[Any]] = {}
        reader = self._reader()
        wanted = [c for c in reader.connections if c.topic == self.topic or c.msgtype in (*_POSE_TYPES, *_TF_TYPES)]
        for connection, arrived, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == self.topic:
                arrival.setdefault(_stamp(message, arrived), arrived)
                self._lidar = self._lidar or message.header.frame_id.lstrip("/")
            elif connection.msgtype in _TF_TYPES:
                for link in message.transforms:
                    child, T = link.child_frame_id.lstrip("/"), link.transform  # ROS 1 allows a leading slash
                    parents[child] = link.header.frame_id.lstrip("/")
                    links.setdefault(child, []).append(sample(_stamp(link, arrived), T.translation, T.rotation))
            else:
                pose = getattr(message.pose, "pose", message.pose)
                at = sample(_stamp(message, arrived), pose.position, pose.orientation)
                tracks.setdefault(connection.topic, []).append(at)
                self._child[connection.topic] = getattr(message, "child_frame_id", "").lstrip("/")
        self._frames = Frames(parents, links)
        return arrival, tracks

    def _trajectory(self, poses: str, tracks: dict[str, list[Any]]) -> tuple[np.ndarray, np.ndarray]:
        """Return (M,) int64 times of transforms or messages, and (M, 4, 4) `T_world_ego` at these times."""
        if poses == "tf":
            times = self._frames.change_times(self.frame)
            matrices = self._frames.in_root(self.frame, times)
        else:
            times, matrices = sorted_poses(tracks.get(poses, []), poses)
            child = self._child.get(poses, "")
            if child and self._frames.are_joined(child, self.frame):
                matrices = matrices @ self._frames.between(child, self.frame, times)
        if len(times) < 2:
            raise CFlowError(f"poses={poses}: fewer than two poses of {self.frame}; choose others, or poses=null")
        return times, matrices

    def _cloud(self, time: int) -> dict[str, np.ndarray]:
        """Read the `cloud_columns` of the cloud at a time."""
        with file_errors(f"{self.path}, {self.topic} at {time} ns"):
            reader, arrived = self._reader(), self._arrival[time]
            clouds = [connection for connection in reader.connections if connection.topic == self.topic]
            for connection, _, data in reader.messages(clouds, start=arrived, stop=arrived + 1):
                message = reader.deserialize(data, connection.msgtype)
                if _stamp(message, arrived) == time:
                    return cloud_columns(message)
            raise CFlowError("the cloud is gone; was the bag changed?")


def _points(columns: dict[str, np.ndarray]) -> np.ndarray:
    """Return (N, 3) points in the frame of the cloud."""
    return np.stack([columns[axis] for axis in "xyz"], axis=1)


def _stamp(message: Any, arrived: int) -> int:
    """Return the time of a header in nanoseconds; if it is 0, the time of arrival."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or arrived


def _bags_in(folder: Path) -> list[Path]:
    if (folder / "metadata.yaml").is_file():
        return [folder]
    return [file for file in folder.iterdir() if file.suffix in SUFFIXES and file.is_file()]
