"""Experimental reader of ROS 1, ROS 2 and MCAP bags, by rosbags (extra `bags`)."""

from __future__ import annotations

import os
import re
from contextlib import closing, suppress
from importlib.metadata import version
from operator import methodcaller
from pathlib import Path
from typing import Any, Sequence

import numpy as np

from cflow_torch.data.arrays.folder import find_poses_near
from cflow_torch.data.arrays.poses_text import read_poses
from cflow_torch.data.bags.messages import BASE, Frames, Sample, cloud_columns, is_pose, points_of, sample, sorted_poses
from cflow_torch.data.file_errors import file_errors, shortened
from cflow_torch.data.folders import search, visible
from cflow_torch.data.log import Log
from cflow_torch.data.paths import PathLike, as_path, check_file, is_remote
from cflow_torch.data.point_times import find_times
from cflow_torch.data.trajectory import Trajectory
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.transforms import rigid_transform, transform_points
from cflow_torch.types import Sweep

SUFFIXES = (".bag", ".mcap", ".db3")
_ACTIVE = ".active"  # of a recording that was not finished
_PART = re.compile("(.+)_([0-9]+)")  # recorders number the parts of a bag from 0
_START = re.compile("[0-9]{4}(-[0-9]{2}){5}")  # of a part, in names by rosbag record --split
SEARCH_DEPTH = 3
_CLOUD = "sensor_msgs/msg/PointCloud2"
_LIVOX = tuple(f"{name}/msg/CustomMsg" for name in ("livox_ros_driver2", "livox_ros_driver", "livox_interfaces"))
_CUSTOM_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
_CUSTOM_MSG = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points"
)
# Messages that hold clouds which we do not decode, and what converts them to PointCloud2.
_CONVERTERS = {
    "CompressedPointCloud2": "point_cloud_transport's republish, or cloudini_rosbag_converter",
    "VelodyneScan": "velodyne_pointcloud's transform node",
    "PacketMsg": "ouster_ros' replay, or ouster-cli",
    "UdpFrame": "the driver of Hesai",
    "PandarScan": "the driver of Hesai, or nebula_ros",
    "NebulaPackets": "nebula_ros",
    "RslidarPacket": "rslidar_sdk",
    "RslidarScan": "rslidar_sdk",
}
_REPAIR = "a recording that was cut off is repaired by rosbag reindex (.bag), mcap recover (.mcap) or sqlite3 (.db3)"
_POSE_TYPES = ("nav_msgs/msg/Odometry", *(f"geometry_msgs/msg/Pose{name}Stamped" for name in ("", "WithCovariance")))
_OTHER_POSES = ("nav_msgs/msg/Path", "geometry_msgs/msg/TransformStamped")  # used if there are no others
_TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_MOVING = (*_TF_TYPES, *_POSE_TYPES)
_MOST_OTHERS = 10  # bags next to one without poses, in which we look for some
_ANOTHER_CLOCK = 1_000_000_000  # nanoseconds; clocks of one computer differ by less
_LARGEST_DELAY = 500_000_000  # nanoseconds by which messages arrive later than others
_EARLY = 100_000_000  # nanoseconds; a message that arrives so long before its time has another clock than the recorder
_SLOWEST = 100  # the factor by which arrivals grow faster than stamps, at least
_AROUND = 3  # clouds before, and after, a fall of the stamps, at most
_NEED = "bags need rosbags (extra bags): pip install rosbags"
_LOST = "{} that are NaN or zeros are left out"


def find_bags(root: PathLike) -> list[Path]:
    """Find all bags in a folder, at most three levels down, sorted; or return the given bag.

    Bags are files `.bag` (ROS 1), `.mcap`, `.db3`, and folders with a metadata.yaml (ROS 2). Files drive_0.bag,
    drive_1.bag, ... are the parts of one bag, also if the time of each part is in its name. The bag is called by its
    first part, and `BagLog` opens them all.
    """
    return sorted(search(as_path(root), _bags_in, SEARCH_DEPTH, "a bag, or a folder of bags"))


class BagLog(Log):
    """One bag. Experimental: tested on bags that rosbags wrote, never on a recorded one.

    Args:
        path: a file, or the folder of a ROS 2 bag, on this machine.
        topic: topic of the clouds (sensor_msgs/PointCloud2, or Livox' CustomMsg); None = the only one of this type.
        poses: "tf" = from the transforms; a topic of nav_msgs/Odometry, geometry_msgs/PoseStamped or
            PoseWithCovarianceStamped; a file of poses of the ego frame with times (TUM); None = no poses; "auto" = the
            first available of: transforms in which the ego frame moves, the only topic of these types, the only file in
            a folder near the bag that has poses at the times of the clouds, none.
        frame: name of the ego frame; None = the vehicle that carries the LiDAR or drives in the frame of the clouds,
            see `Frames.vehicle_of`, else the child of a topic that drives in it, else the LiDAR's own.
        ego_T_lidar: (4, 4), maps the frame of the clouds to the ego frame; None = from the transforms.

    Attributes:
        poses: (K, 4, 4) float64 `T_world_ego` of every sweep; None = unknown.
        trajectory: times and `T_world_ego` of all transforms or messages, by which `DeskewedLog` moves points.
        timestamps: nanoseconds from the header of each cloud; of a header of 0, the time of arrival. If headers hardly
            change from one cloud to the next, all are times of arrival. If a clock was set back, we add the step to
            later times. If the clocks of clouds and poses surely differ, times are shifted to that of the poses. Each
            of these is said. Clouds before the first or after the last pose are left out.
        topic, frame: the settings in use.

    Convention: points are in the ego frame, as measured (`open_log` de-skews them). Poses are interpolated at the time
        of the cloud. The world is the root of the transforms, or the world of the topic. A topic gives the poses of its
        `child_frame_id` if transforms connect this frame to the ego frame, otherwise the poses of the ego frame. Times
        of points: `point_times.seconds_after`.

    Cost: opening a bag reads all its clouds, poses and transforms once.
    """

    has_raw_times: bool = True

    def __init__(
        self,
        path: PathLike,
        topic: str | None = None,
        poses: str | None = "auto",
        frame: str | None = None,
        ego_T_lidar: Any = None,
    ) -> None:
        self.path = as_path(path)
        if is_remote(self.path):
            raise CFlowError(f"{self.path} is remote: bags are read from this machine only; copy it here")
        self._files = _parts(self.path)
        name = self.path.resolve()
        stem = _PART.sub(r"\1", name.stem) if len(self._files) > 1 else name.stem  # that of parts has no number
        self.log_id = name.name if name.is_dir() else stem
        if self.path.suffix == _ACTIVE:
            raise CFlowError(
                f"{self.path} is a recording that was not finished: run rosbag reindex, then rename it .bag"
            )
        self.poses = None
        self._opened: tuple[int, Any] = (0, None)
        self._mount = None if ego_T_lidar is None else rigid_transform(ego_T_lidar, "ego_T_lidar")
        hint = f"is it a complete bag of ROS 1 (.bag), ROS 2 (folder) or MCAP? {_REPAIR}"
        with file_errors(f"{self.path}", hint):
            topics = {connection.topic: connection.msgtype for connection in self._reader().connections}
            self.topic = self._cloud_topic(topics, topic)
            self._clouds, tracks = self._scan()
            self.frame = frame or self._ego_frame()
            self.timestamps = sorted(self._clouds)
            self._check_count(f"{self.path}: {self.topic}")
            trajectory = self._find_poses(topics, poses, tracks)
            if trajectory is not None:
                self._use_poses(trajectory, f"{self.path}: {self.topic}, while there are poses,")
            self._period = float(np.median(np.diff(self.timestamps))) * 1e-9
            self.lidar_position = self._mount_at(self.timestamps[0])[:3, 3]

    def _cloud_topic(self, topics: dict[str, str], name: str | None) -> str:
        """Return the topic of the clouds; without a name, Livox' messages count only if there are no others."""
        has_clouds = _CLOUD in topics.values() or not set(_LIVOX) & set(topics.values())
        return self._chosen(topics, (_CLOUD,) if has_clouds and not name else (_CLOUD, *_LIVOX), name, "topic")

    def _find_poses(self, topics: dict[str, str], poses: str | None, tracks: dict[str, Any]) -> Trajectory | None:
        """Return the poses of the file, topic or transforms that `poses` names or finds; None = there are none.

        Clouds of another clock than transforms or a topic are shifted.
        """
        files = [] if poses is None else [path for path in (as_path(poses), self.path.parent / poses) if path.is_file()]
        if files:
            trajectory = read_poses(files[0])
            if trajectory.times_ns is None:
                raise CFlowError(f"{files[0]} has no times: give a bag poses with times (TUM)")
            return trajectory
        source = poses
        if poses == "auto":
            source = "tf" if len(self._frames.change_times(self.frame)) > 1 else None
            if source is None and tracks:
                has_usual = not set(_POSE_TYPES).isdisjoint(topics.values())
                source = self._chosen(topics, _POSE_TYPES if has_usual else _OTHER_POSES, None, "poses")
        elif poses not in (None, "tf"):
            source = self._chosen(topics, (*_POSE_TYPES, *_OTHER_POSES), poses, "poses")
        if source is not None:
            times, matrices = self._find_trajectory(source, tracks)
            self._set_clock(times)
            return Trajectory(matrices, times, False, f"{source} of {self.path}")
        if poses is None:
            return None
        fits = methodcaller("covers", self.timestamps)
        near = find_poses_near(self.path.parent, self.log_id, self.timestamps, fits, self._note)
        if near is None:
            self._note(self._other_bag_with_poses())
        return near

    def _other_bag_with_poses(self) -> str:
        """Name a bag next to this one that has poses of the same time; "" = there is none."""
        arrived = [arrival for arrival, _ in self._clouds.values()]
        parent = self.path.resolve().parent
        folders = [parent, *(path for path in visible(parent) if path.is_dir())]
        bags = [bag for folder in folders for bag in _bags_in(folder) if not bag.samefile(self.path)]
        for bag in sorted(bags)[:_MOST_OTHERS]:
            parts = _parts(bag)
            moving = _topics_of_poses(parts, min(arrived), max(arrived))
            if moving:
                files = " ".join([*(file.name for file in self._files), *(str(p.relative_to(parent)) for p in parts)])
                what = f"{bag.relative_to(parent)} next to it has {', '.join(moving)} of the same time"
                return f"{what}, which we do not read: merge both by rosbags-convert --src {files} --dst merged"
        return ""

    def _mount_at(self, time: int) -> np.ndarray:
        """Return `T_ego_lidar` at a time, (4, 4) float64."""
        if self._mount is not None:
            return self._mount
        return self._frames.between(self.frame, self._lidar, np.array([time]))[0]  # type: ignore[no-any-return]

    def mounting_with(self, T_poses_points: np.ndarray) -> np.ndarray:
        return T_poses_points @ self._mount_at(self.timestamps[0])

    def sweep(self, index: int) -> Sweep:
        time = self._timestamp(index)
        columns, times = self._timed_cloud(time)
        points = transform_points(points_of(columns), self._mount_at(time))
        pose = None if self.poses is None else self.poses[index].copy()
        return Sweep(points.astype(np.float32), None, pose, time, times)

    def columns(self, index: int) -> dict[str, np.ndarray]:
        """Read the fields besides x, y, z, such as intensity and ring, of the points of sweep `index`."""
        columns, _ = self._timed_cloud(self._timestamp(index))
        return {name: values for name, values in columns.items() if name not in ("x", "y", "z")}

    def _timed_cloud(self, time: int) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
        """Read a cloud and the (N,) seconds of its points; None = unknown. We leave out points of stray times."""
        columns = self._cloud(time)
        times = find_times(columns, self._clouds[time][1], self._period, self._note)
        if times is None or times.seconds is None:
            return columns, None
        kept = ~times.is_stray
        return {name: values[kept] for name, values in columns.items()}, times.seconds[kept]

    def _reader(self) -> Any:
        """Return the open bag. Each process opens it itself, also after a fork or unpickling."""
        if self._opened[0] != os.getpid():
            self._opened = (os.getpid(), _open_bag(self._files))
        return self._opened[1]

    def close(self) -> None:
        """Close the bag. A sweep that is read later opens it again."""
        owner, reader = self._opened
        if owner == os.getpid():
            reader.close()
        self._opened = (0, None)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": (0, None)}

    def _chosen(self, topics: dict[str, str], types: tuple[str, ...], name: str | None, setting: str) -> str:
        """Return the topic with this name and one of these types; without a name, the only topic of these types."""
        found = sorted(topic for topic, kind in topics.items() if kind in types and name in (None, topic))
        if len(found) != 1:
            available = shortened(", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())))
            what = f"{setting}={name}" if name else f"{len(found)} topics"
            for topic, kind in sorted(topics.items()):
                if _CLOUD in types and not found and kind.split("/")[-1] in _CONVERTERS:
                    tool = _CONVERTERS[kind.split("/")[-1]]
                    raise CFlowError(f"{topic} has messages {kind}, which we do not decode: convert it with {tool}")
            if not found and not name:
                raise CFlowError(f"it has no topic of type {' or '.join(types)}; it has {available or 'no messages'}")
            raise CFlowError(
                f"{what} of type {' or '.join(types)}: choose one with {setting}=NAME, "
                f"in commands data.{setting}=NAME; the bag has {available}"
            )
        return found[0]

    def _ego_frame(self) -> str:
        """Return the frame of the vehicle. Without transforms to the LiDAR, it is the LiDAR's own."""
        frames, lidar = self._frames, self._lidar
        driven = [child for child in self._child.values() if frames.drives_in(child, lidar)]
        vehicle = frames.vehicle_of(lidar) or next(iter(driven), "")
        if vehicle:
            if frames.drives_in(vehicle, lidar):  # an odometry that publishes registered clouds
                self._note(f"its clouds are in {lidar}, the frame of the world; we move them to {vehicle}")
            return vehicle
        for name in filter(None, (BASE, *self._child.values())):
            is_in_tf = len(frames.change_times(name)) > 1
            if frames.are_joined(name, lidar):
                continue
            if self._mount is None and (is_in_tf or name in self._child.values()):
                self._note(
                    f"no transform connects its LiDAR ({lidar}) to {name}, whose poses it has. We assume that both are "
                    "in one place; pass the mounting of the LiDAR, ego_T_lidar (data.ego_T_lidar)",
                    "missing link",
                )
            if is_in_tf:
                self._mount = np.eye(4) if self._mount is None else self._mount
                return name
        moving = frames.moving_in(lidar)
        if moving:
            names = shortened(", ".join(moving))
            self._note(
                f"{names} move in {lidar}, the frame of its clouds. If one is the vehicle, choose it by frame "
                "(data.frame)"
            )
        return lidar

    def _scan(self) -> tuple[dict[int, tuple[int, int]], dict[str, list[Any]]]:
        """Read all messages once. Return the clouds (see `_timed`) and the pose samples of each topic."""
        self._lidar = ""
        self._child: dict[str, str] = {}
        self._pose_delays: list[int] = []  # nanoseconds from the times of poses and transforms to their arrival
        stamps: list[tuple[int, int]] = []  # of each cloud: its header's, and its arrival
        links: dict[tuple[str, str], list[Sample]] = {}
        tracks: dict[str, list[Any]] = {}
        reader = self._reader()
        types = (*_POSE_TYPES, *_OTHER_POSES, *_TF_TYPES)
        wanted = [c for c in reader.connections if c.topic == self.topic or c.msgtype in types]
        for connection, arrived, data in reader.messages(wanted):
            message = reader.deserialize(data, connection.msgtype)
            if connection.topic == self.topic:
                frame = _frame_of(message)
                self._lidar = self._lidar or frame
                if frame == self._lidar:
                    stamps.append((_stamp(message, 0), arrived))
                else:
                    self._note(f"its clouds are of several sensors: we read those in {self._lidar}, not in {frame}")
            elif connection.msgtype in _TF_TYPES:
                self._add_transforms(message, arrived, links)
            else:
                self._add_poses(connection.topic, message, arrived, tracks)
        self._frames = Frames(links)
        ignored = self._frames.ignored(self._lidar, BASE)
        self._note(
            f"frames have several parents: we ignore the transforms that are rarer, {ignored}" if ignored else ""
        )
        if self._frames.inverted_world:
            world, vehicle = self._frames.inverted_world
            self._note(f"its transforms are those from {vehicle} to {world}, so we invert them to get poses in {world}")
        return self._timed(stamps), tracks

    def _add_transforms(self, message: Any, arrived: int, links: dict[tuple[str, str], list[Sample]]) -> None:
        """Add the transforms of a message to the samples of each parent and frame."""
        for link in message.transforms:
            pose = _pose_of(link, arrived)
            if not is_pose(pose):
                self._note(_LOST.format("transforms"))
                continue
            self._pose_delays.append(arrived - int(pose[0]))
            links.setdefault((_frame_of(link), link.child_frame_id.lstrip("/")), []).append(pose)

    def _add_poses(self, topic: str, message: Any, arrived: int, tracks: dict[str, list[Sample]]) -> None:
        """Add the poses of a message to those of its topic."""
        driven = _driven(message, arrived)
        poses = list(filter(is_pose, driven))
        self._note(_LOST.format("poses") if len(poses) < len(driven) else "")
        if not poses:
            return
        if hasattr(message, "poses"):
            tracks[topic] = []  # each message repeats the path so far
        tracks.setdefault(topic, []).extend(poses)
        self._pose_delays.append(arrived - int(poses[-1][0]))
        self._child[topic] = getattr(message, "child_frame_id", "").lstrip("/")

    def _timed(self, stamps: list[tuple[int, int]]) -> dict[int, tuple[int, int]]:
        """Return the arrival and the stamp of each cloud by its time.

        Stamps that hardly grow from one arrival to the next are replaced by the arrivals. If they fall, and the delays
        grow at once, a clock was set back, and we let it run on. A note says what was done.

        Args:
            stamps: of each cloud, its stamp, which may be 0, and its arrival, in the order of arrival.
        """
        is_same = [abs(b[0] - a[0]) < (b[1] - a[1]) / _SLOWEST for a, b in zip(stamps, stamps[1:])]
        if sum(is_same) > max(len(stamps) // 2 - 1, 0):
            count = len(stamps) - sum(is_same)
            self._note(f"its {len(stamps)} clouds have {count} different time stamps, so we use their times of arrival")
            return {arrived: (arrived, stamp or arrived) for stamp, arrived in stamps}
        arrival: dict[int, int] = {}
        for stamp, arrived in stamps:
            arrival.setdefault(stamp or arrived, arrived)  # clouds that are played twice repeat their stamps
        first = list(arrival.items())
        if len(first) < len(stamps):
            count = len(stamps) - len(first)
            self._note(f"{count} clouds repeat the time stamp of an earlier one and are left out; was it played twice?")
        delay = [arrived - stamp for stamp, arrived in first]
        shift = np.zeros(len(first), np.int64)
        for k in range(1, len(first) - 1):  # a late message would look like a step before the last cloud
            before, after = sorted(delay[max(k - _AROUND, 0) : k]), sorted(delay[k : k + _AROUND])
            jump, spread = after[0] - before[-1], max(after[-1] - after[0], before[-1] - before[0])
            if first[k][0] < first[k - 1][0] and jump > spread:  # else messages arrived late
                back = _middle(after) - _middle(before)
                shift[k:] += back
                self._note(f"the clock of its clouds was set back by {back * 1e-9:.3g} s, so we add that to later ones")
        return {stamp + by: (arrived, stamp) for (stamp, arrived), by in zip(first, shift.tolist())}

    def _set_clock(self, pose_times: np.ndarray) -> None:
        """Shift the times of clouds to the clock of the poses, by the times of arrival, if the clocks surely differ.

        They do if the times do not overlap, or if messages of one kind only arrive before their time. Otherwise poses
        may arrive late, because they take long to compute.
        """
        first, last = self.timestamps[0], self.timestamps[-1]
        delays = [arrived - time for time, (arrived, _) in self._clouds.items()], self._pose_delays
        shift = _middle(delays[0]) - _middle(delays[1])
        do_overlap = last >= pose_times[0] and first <= pose_times[-1]
        if abs(shift) < (_LARGEST_DELAY if do_overlap else _ANOTHER_CLOCK):
            return
        seconds = f"{shift * 1e-9:+.6g} s by the times of arrival"
        are_early = [sorted(each)[len(each) * 9 // 10] < -_EARLY for each in delays if each]
        if do_overlap and sum(are_early) != 1:
            self._note(f"clocks of its clouds and poses differ by {seconds}: if static points move, correct one")
            return
        self._clouds = {time + shift: cloud for time, cloud in self._clouds.items()}
        self.timestamps = sorted(self._clouds)
        self._note(
            f"the times of its clouds and of its poses have different clocks ({seconds}), so we shift those of the "
            "clouds"
        )

    def _find_trajectory(self, poses: str, tracks: dict[str, list[Any]]) -> tuple[np.ndarray, np.ndarray]:
        """Return (M,) int64 times of transforms or messages, and (M, 4, 4) `T_world_ego` at these times."""
        child = self._child.get(poses, "") if poses != "tf" else self.frame
        if poses == "tf":
            times, world = self._frames.change_times(self.frame), self._frames.world_of(self.frame)
            matrices = self._frames.between(world, self.frame, times)
            if world != self._frames.chain(self.frame)[-1]:
                parent = self._frames.chain(world)[1]
                self._note(
                    f"the transform from {parent} to {world} jumps, so poses are in {world}, which is continuous"
                )
        else:
            times, matrices = sorted_poses(tracks.get(poses, []), poses)
        if child and self._frames.are_joined(child, self.frame):
            matrices = matrices @ self._frames.between(child, self.frame, times)
            if self._mount is not None and self.frame == self._lidar:
                matrices = matrices @ np.linalg.inv(self._mount)
        if len(times) < 2:
            raise CFlowError(f"poses={poses}: fewer than two poses of {self.frame}; choose others, or poses=null")
        return times, matrices

    def _cloud(self, time: int) -> dict[str, np.ndarray]:
        """Read the `cloud_columns` of the cloud at a time."""
        with file_errors(f"{self.path}, {self.topic} at {time} ns"):
            reader, (arrived, stamp) = self._reader(), self._clouds[time]
            clouds = [connection for connection in reader.connections if connection.topic == self.topic]
            for connection, _, data in reader.messages(clouds, start=arrived, stop=arrived + 1):
                message = reader.deserialize(data, connection.msgtype)
                if _stamp(message, arrived) == stamp and _frame_of(message) == self._lidar:
                    return cloud_columns(message)
            raise CFlowError("the cloud is gone; was the bag changed?")


def _middle(values: list[int]) -> int:
    return sorted(values)[len(values) // 2] if values else 0


def _stamp(message: Any, arrived: int) -> int:
    """Return the time of a header in nanoseconds, that of arrival if it is 0."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or arrived


def _frame_of(message: Any) -> str:
    return str(message.header.frame_id.lstrip("/"))  # ROS 1 allows a leading slash


def _pose_of(message: Any, arrived: int) -> Sample:
    """Return the pose of an Odometry, a PoseStamped, a PoseWithCovarianceStamped or a TransformStamped."""
    if hasattr(message, "transform"):
        return sample(_stamp(message, arrived), message.transform.translation, message.transform.rotation)
    pose = getattr(message.pose, "pose", message.pose)
    return sample(_stamp(message, arrived), pose.position, pose.orientation)


def _driven(message: Any, arrived: int) -> list[Sample]:
    """Return the poses of a message, or of the path in it; none if the path is only planned, so without times."""
    poses = [_pose_of(each, arrived) for each in getattr(message, "poses", [message])]
    times = {pose[0] for pose in poses}
    return poses if len(times) == len(poses) else []


def _check_version(files: list[Path]) -> None:
    """Say that this version of rosbags opens files of ROS 2 only by the metadata.yaml that names them."""
    is_old = [int(number) for number in version("rosbags").split(".")[:2]] < [0, 11]
    for file in files if is_old else ():
        if file.suffix in (".db3", ".mcap"):
            raise CFlowError(f"{file} has no metadata.yaml that names it: rosbags 0.11 (Python 3.10) reads such files")


def _bags_in(folder: Path) -> list[Path]:
    if folder.is_file() or (folder / "metadata.yaml").is_file():
        return [folder]
    files = [file for file in visible(folder) if file.suffix in (*SUFFIXES, _ACTIVE) and file.is_file()]
    parts = {part for file in files for part in _parts(file, files)[1:]}
    return [file for file in files if file not in parts]


def _open_bag(files: list[Path]) -> Any:
    """Open files as one bag."""
    rosbags, types = (import_optional(f"rosbags.{name}", _NEED) for name in ("highlevel", "typesys"))
    for path in files:
        for file in [path] if path.is_file() else path.iterdir():
            check_file(file)
    _check_version(files)
    # Bags of ROS 2 before Iron do not describe their messages. The types that we read never changed.
    types_of_old_bags = types.get_typestore(types.Stores.ROS2_HUMBLE)
    for name in _LIVOX:
        for kind, definition in (("CustomPoint", _CUSTOM_POINT), ("CustomMsg", _CUSTOM_MSG)):
            types_of_old_bags.register(types.get_types_from_msg(definition, name.replace("CustomMsg", kind)))
    reader = rosbags.AnyReader(files, default_typestore=types_of_old_bags)
    reader.open()
    return reader


def _topics_of_poses(files: list[Path], first_ns: int, last_ns: int) -> list[str]:
    """Return the topics of a bag that have poses or moving transforms, if it has messages between two times."""
    # Any error of a library is ignored, because nobody has given these files.
    with suppress(Exception), closing(_open_bag(files)) as reader:
        if reader.start_time <= last_ns and reader.end_time >= first_ns:
            kinds = {each.topic: each.msgtype for each in reader.connections}
            return sorted(topic for topic, kind in kinds.items() if kind in _MOVING and topic != "/tf_static")
    return []


def _parts(path: Path, files: Sequence[Path] | None = None) -> list[Path]:
    """Return the paths that rosbags must open for a bag. `files` are those next to it; None = we list them.

    Parts of a recording have one name, apart from the number and the time. They start with the first part or later, but
    before the first part of the next recording of this name.
    """
    if path.is_dir():
        description = path / "metadata.yaml"
        text = description.read_text("utf-8", "replace") if description.is_file() else ""
        named = re.findall(r"^\s*- (\S+\.(?:db3|mcap))\s*$", text, re.MULTILINE)
        if all((path / name).is_file() for name in named):
            return [path]
        renamed = [file for file in visible(path) if file.suffix in SUFFIXES]
        return sorted(renamed, key=lambda file: _part_of(file)[2]) or [path]
    name, first, own_number = _part_of(path)
    if own_number != 0:
        return [path]
    others = list(path.parent.glob("*")) if files is None else files
    known = [(*_part_of(file), file) for file in others if file.suffix == path.suffix]
    known = [each for each in known if each[0] == name and each[1] >= first and each[2] >= 0]
    end = min((start for _, start, number, _ in known if number == 0 and start > first), default=None)
    after = sorted((number, file) for _, start, number, file in known if end is None or start < end)
    numbers = [number for number, _ in after]
    parts: list[Path] = []
    for number, file in after:
        # Two files of one number are of two recordings at a time, if their names have times.
        if number == len(parts) and (not first or numbers.count(number) == 1):
            parts.append(file)
    return parts or [path]  # two recordings of one name and time


def _part_of(file: Path) -> tuple[str, str, int]:
    """Return the name of a file without its time and number, the time, "" = none, and the number, -1 = none."""
    match = _PART.fullmatch(file.stem)
    stem, number = (match[1], int(match[2])) if match else (file.stem, -1)
    start = _START.search(stem)
    return _START.sub("", stem, count=1), start[0] if start else "", number
