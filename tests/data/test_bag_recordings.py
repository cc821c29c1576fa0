"""Bags as people have them: in parts, with missing links, other clocks, corrections, other messages."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Callable

import numpy as np
import pytest
from bag_writer import MOUNT, BagWriter, rosbag2, typesys, write_bag
from test_bags import world_of
from tiny_recording import TinyRecording

from cflow_torch import CFlowError
from cflow_torch.data.bags import BagLog, find_bags
from cflow_torch.data.bags.messages import cloud_columns, points_of
from cflow_torch.data.bags.reader import _parts
from cflow_torch.data.catalog import open_log, recognise
from cflow_torch.transforms import as_matrix
from cflow_torch.types import CFlowWarning

TF, CLOUD, ODOMETRY = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry"
STEP = 20_000_000


class Recorder:
    """Write clouds, transforms and odometry of a tiny recording."""

    def __init__(self, folder: Path, form: str = "ros1", num_sweeps: int = 8) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.writer, self.recording = BagWriter(folder, form), TinyRecording(("velodyne",), num_sweeps=num_sweeps)
        self.recording.mounts["velodyne"] = MOUNT
        self.stamps = self.recording.timestamps

    def transform(self, stamp: int, parent: str, child: str, T: np.ndarray) -> None:
        self.writer.write("/tf", stamp, TF, [self.writer.transform(stamp, parent, child, T)])

    def mount(self) -> None:
        self.transform(self.stamps[0], "base_link", "velodyne", MOUNT)

    def drive(self, start: int = -2, end: int = 20, lag: int = 0) -> None:
        """Transforms of the vehicle from sweep `start` to `end`, 50 a second."""
        first = self.stamps[0]
        for stamp in range(first + start * 10**8, first + end * 10**8, STEP):
            self.transform(stamp + lag, "odom", "base_link", self.recording.pose_at(stamp))

    def odometry(self, child: str = "base_link", parent: str = "odom") -> None:
        make = self.writer.make
        zero = make("geometry_msgs/msg/Vector3", 0, 0, 0)
        twist = make("geometry_msgs/msg/TwistWithCovariance", make("geometry_msgs/msg/Twist", zero, zero), np.zeros(36))
        for stamp in range(self.stamps[0] - 10**8, self.stamps[-1] + 2 * 10**8, STEP):
            pose = self.writer.pose(self.recording.pose_at(stamp))
            pose = make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
            self.writer.write("/odom", stamp, ODOMETRY, self.writer.header(stamp, parent), child, pose, twist)

    def clouds(self, sweeps: Any = None, stamp: Callable[[int], int] = int, lag: int = 0) -> None:
        """Clouds that arrive `lag` nanoseconds after the times of their sweeps."""
        for k in range(8) if sweeps is None else sweeps:
            unit = self.recording.units(k)[0]
            fields = self.writer.cloud(stamp(self.stamps[k]), unit.points, None)
            self.writer.write("/points", self.stamps[k] + lag, CLOUD, *fields)

    def registered(self, *frames: str) -> None:
        """Clouds in the frame of the world, and the transforms of frames that drive in it, one after another."""
        for k, stamp in enumerate(self.stamps):
            for n, frame in enumerate(frames):
                self.transform(stamp, "camera_init", frame, self.recording.pose_at(stamp - n * STEP))
            T = self.recording.pose_at(stamp)
            points = self.recording.units(k)[0].points @ T[:3, :3].T + T[:3, 3]
            header, *fields = self.writer.cloud(stamp, points.astype(np.float32), None)
            header.frame_id = "camera_init"
            self.writer.write("/registered", stamp, CLOUD, header, *fields)

    def close(self) -> Path:
        self.writer.bag.close()
        return next(Path(self.writer.bag.path).parent.glob("drive*"))


def world(log: BagLog, recording: TinyRecording) -> float:
    """Largest error of static points in the world, of the sweeps that the log has, metres."""
    errors = []
    for sweep in log:
        truth = recording.units(list(recording.timestamps).index(sweep.timestamp_ns))[0].points
        lidar = recording.pose_at(sweep.timestamp_ns) @ MOUNT
        errors.append(np.abs(world_of(sweep) - truth @ lidar[:3, :3].T - lidar[:3, 3]).max())
    return float(max(errors))


def test_parts_of_a_bag_are_joined(tmp_path) -> None:
    """The second part alone has no mounting of the LiDAR."""
    for number, sweeps in enumerate((range(4), range(4, 8))):
        part = Recorder(tmp_path / str(number))
        if number == 0:
            part.mount()
        part.drive(4 * number - 2, 4 * number + 6)
        part.clouds(sweeps)
        part.close().rename(tmp_path / f"drive_{number}.bag")
    assert find_bags(tmp_path) == [tmp_path / "drive_0.bag"]
    log = BagLog(tmp_path / "drive_0.bag")
    assert log.log_id == "drive" and len(log) == 8 and world(log, part.recording) < 5e-3


def test_parts_are_joined_if_their_names_have_their_times(tmp_path) -> None:
    """As rosbag record --split names them; two recordings follow each other, and two others ran at a time."""
    drive = [f"2024-01-05-10-0{minute}-00_{number}.bag" for minute, number in enumerate((0, 1, 2, 0, 1))]
    mixed = [f"run_2024-01-05-10-0{minute}-00_{number}.bag" for minute, number in enumerate((0, 0, 1, 1))]
    for name in (*drive, *mixed):
        (tmp_path / name).touch()
    found = [path.name for path in find_bags(tmp_path)]
    assert found == [drive[0], drive[3], *mixed]
    assert [path.name for path in _parts(tmp_path / drive[0])] == drive[:3]
    assert [path.name for path in _parts(tmp_path / drive[3])] == drive[3:]


def test_folders_without_or_with_old_metadata_are_read(tmp_path) -> None:
    folder = write_bag(tmp_path, "ros2", TinyRecording(("velodyne",), num_sweeps=3))
    (file,) = folder.glob("*.db3")
    file.rename(folder / "renamed.db3")
    if not hasattr(rosbag2, "StoragePlugin"):  # rosbags of Python 3.8
        with pytest.raises(CFlowError, match=r"renamed\.db3 has no metadata.yaml .*rosbags 0\.11"):
            BagLog(folder)
        return
    assert len(BagLog(folder)) == 3
    (folder / "metadata.yaml").unlink()
    assert [len(BagLog(bag)) for bag in find_bags(tmp_path)] == [3]


def test_a_missing_link_is_named(tmp_path) -> None:
    bag = Recorder(tmp_path / "a")
    bag.odometry()
    bag.clouds()
    path = bag.close()
    with pytest.warns(CFlowWarning, match=r"no transform connects its LiDAR \(velodyne\) to base_link.*ego_T_lidar"):
        BagLog(path)
    bag = Recorder(tmp_path / "b")
    bag.drive()
    bag.clouds()
    path = bag.close()
    with pytest.warns(CFlowWarning, match="We assume that both are in one place"):
        assumed = BagLog(path)
    assert np.allclose(assumed.poses[3], bag.recording.pose_at(assumed.timestamps[3]))
    log = BagLog(path, ego_T_lidar=MOUNT)
    assert log.frame == "base_link" and world(log, bag.recording) < 5e-3
    assert np.allclose(log.mounting_with(MOUNT), MOUNT @ MOUNT), "the setting replaces the mounting in use"


def test_a_bag_next_to_one_without_poses_is_named_if_it_has_some(tmp_path, recwarn) -> None:
    """Clouds and transforms were recorded into two bags; a third one is of another time."""
    bag = Recorder(tmp_path / "clouds")
    bag.clouds()
    clouds = bag.close().rename(tmp_path / "lidar.bag")
    for name, start, end in (("later", 900, 901), ("poses", -2, 20)):
        bag = Recorder(tmp_path / name)
        bag.mount() if name == "poses" else None
        bag.drive(start, end)
        bag.close().rename(tmp_path / f"{name}.bag")
    (note,) = BagLog(clouds).notes
    assert note.startswith("poses.bag next to it has /tf of the same time, which we do not read: merge both by ")
    assert note.endswith("rosbags-convert --src lidar.bag poses.bag --dst merged")


def test_transforms_connect_frames_in_either_direction(tmp_path) -> None:
    """The vehicle below its LiDAR, and the frame of the world below the vehicle, as KISS-ICP publishes it."""
    mounted = Recorder(tmp_path / "mount")
    mounted.transform(mounted.stamps[0], "velodyne", "base_link", np.linalg.inv(MOUNT))
    mounted.drive()
    mounted.clouds()
    log = BagLog(mounted.close())
    assert log.frame == "base_link" and world(log, mounted.recording) < 5e-3 and not log.notes
    for name, vehicle in (("vehicle", "base_link"), ("lidar", "velodyne")):
        bag = Recorder(tmp_path / name)
        bag.mount()
        for stamp in range(bag.stamps[0] - 10**8, bag.stamps[-1] + 10**8, STEP):
            T = bag.recording.pose_at(stamp) @ (MOUNT if vehicle == "velodyne" else np.eye(4))
            bag.transform(stamp, vehicle, "odom_lidar", np.linalg.inv(T))
        bag.clouds()
        path = bag.close()
        with pytest.warns(CFlowWarning, match=f"from {vehicle} to odom_lidar, so we invert them"):
            log = BagLog(path)
        assert log.frame == "base_link" and world(log, bag.recording) < 5e-3


def test_an_odometry_of_a_frame_below_the_lidar_is_connected(tmp_path, recwarn) -> None:
    """As of an inertial unit in the LiDAR, whose driver publishes where it is."""
    bag = Recorder(tmp_path)
    bag.transform(bag.stamps[0], "velodyne", "imu", np.linalg.inv(MOUNT))
    bag.odometry(child="imu")
    bag.clouds()
    log = BagLog(bag.close())
    assert log.frame == "velodyne" and world(log, bag.recording) < 5e-3
    assert not [each for each in recwarn if "no transform" in str(each.message)]


def test_the_vehicle_is_the_level_frame_that_carries_the_lidar(tmp_path) -> None:
    """Without base_link: a LiDAR that is tilted on a body, and clouds in the frame in which a body drives."""
    bag = Recorder(tmp_path / "body")
    bag.transform(bag.stamps[0], "body", "velodyne", MOUNT)
    for stamp in range(bag.stamps[0] - 10**8, bag.stamps[-1] + 10**8, STEP):
        bag.transform(stamp, "odom", "body", bag.recording.pose_at(stamp))
        bag.transform(stamp, "map", "odom", as_matrix(np.eye(3), (stamp > bag.stamps[4], 0, 0)))
    bag.clouds()
    log = BagLog(bag.close())
    assert log.frame == "body" and world(log, bag.recording) < 5e-3
    given = BagLog(log.path, ego_T_lidar=MOUNT, frame="velodyne")
    assert np.allclose(given.poses, log.poses), "the poses of the LiDAR tell those of the vehicle"


def test_lost_poses_and_transforms_are_left_out_and_said(tmp_path) -> None:
    """Programs write NaN or zeros for a pose that they lost."""
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    make = bag.writer.make
    for stamp, value in ((bag.stamps[3] + 7, np.nan), (bag.stamps[5] + 7, 0.0)):
        vector, turn = (
            make("geometry_msgs/msg/Vector3", value, 0, 0),
            make("geometry_msgs/msg/Quaternion", 0, 0, 0, value),
        )
        link = bag.writer.transform(stamp, "odom", "base_link", np.eye(4))
        fields = link.header, link.child_frame_id, make("geometry_msgs/msg/Transform", vector, turn)
        bag.writer.write("/tf", stamp, TF, [make("geometry_msgs/msg/TransformStamped", *fields)])
    bag.clouds()
    with pytest.warns(CFlowWarning, match="transforms that are NaN or zeros are left out"):
        log = BagLog(bag.close())
    assert len(log) == 8 and world(log, bag.recording) < 5e-3


def test_clouds_of_one_sensor_are_read_if_a_topic_has_two(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    for k in range(8):
        unit = bag.recording.units(k)[0]
        for frame in ("velodyne", "rear"):
            fields = bag.writer.cloud(bag.stamps[k], unit.points if frame == "velodyne" else -unit.points, None)
            fields = [bag.writer.header(bag.stamps[k], frame), *fields[1:]]
            bag.writer.write("/points", bag.stamps[k], CLOUD, *fields)
    with pytest.warns(CFlowWarning, match="clouds are of several sensors: we read those in velodyne, not in rear"):
        log = BagLog(bag.close())
    assert len(log) == 8 and world(log, bag.recording) < 5e-3


def test_other_clocks_are_named_and_late_poses_counted(tmp_path) -> None:
    for name, lag in (("clock", -(10**18)), ("late", 500_000_000)):
        bag = Recorder(tmp_path / name)
        bag.mount()
        bag.drive(lag=lag)
        bag.clouds()
        path = bag.close()
        if name == "clock":
            with pytest.raises(CFlowError, match=r"the clocks differ by about 1e\+09 s"):
                BagLog(path)
        else:
            with pytest.warns(CFlowWarning, match="3 of 8 sweeps have no pose .* 3 before the first pose"):
                assert len(BagLog(path)) == 5


def test_clouds_of_another_clock_are_shifted_by_the_times_of_arrival(tmp_path) -> None:
    """A LiDAR that counts from its start, or is ahead: the bag knows when each message arrived."""
    for name, lag in (("boot", lambda start: 55 * 10**9 - start), ("ahead", lambda _: 800_000_000)):
        bag = Recorder(tmp_path / name)
        bag.mount()
        bag.drive()
        ahead = lag(bag.stamps[0])
        bag.clouds(stamp=lambda stamp, ahead=ahead: stamp + ahead)
        path = bag.close()
        with pytest.warns(CFlowWarning, match="different clocks .* by the times of arrival"):
            log = BagLog(path)
        assert list(log.timestamps) == list(bag.stamps) and world(log, bag.recording) < 5e-3


def test_clouds_that_arrive_late_keep_their_times(tmp_path) -> None:
    """A message may arrive long after its measurement, but not before it."""
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    bag.clouds(stamp=lambda stamp: stamp - 800_000_000)
    path = bag.close()
    with pytest.warns(CFlowWarning, match=r"differ by \+0.8 s by the times of arrival: if static points move"):
        BagLog(path)


def test_repeated_stamps_are_named(tmp_path) -> None:
    for name in ("same", "zero"):
        same = Recorder(tmp_path / name)
        same.mount()
        same.drive()
        first = same.stamps[0] if name == "same" else 0
        same.clouds(stamp=lambda stamp, first=first: first)
        message = "8 clouds have 1 different time stamps, so we use their times of arrival"
        with pytest.warns(CFlowWarning, match=message):
            log = BagLog(same.close())
        assert [time - 40_000_000 for time in log.timestamps] == list(same.stamps)
        assert len({tuple(sweep.points[0]) for sweep in log}) == 8
    coarse = Recorder(tmp_path / "coarse")  # half of the clouds have the stamp of the one before
    coarse.mount()
    coarse.drive()
    coarse.clouds(stamp=lambda stamp: coarse.stamps[coarse.stamps.index(stamp) // 4 * 4])
    with pytest.warns(CFlowWarning, match="8 clouds have 2 different time stamps, so we use their times of arrival"):
        assert len(BagLog(coarse.close())) == 8
    loop = Recorder(tmp_path / "loop")
    loop.mount()
    loop.drive()
    loop.clouds([*range(8), *range(8)])
    with pytest.warns(CFlowWarning, match="8 clouds repeat the time stamp of an earlier one"):
        assert world(BagLog(loop.close()), loop.recording) < 5e-3


def test_a_loop_that_stops_midway_keeps_its_order(tmp_path, recwarn) -> None:
    """The clock of the clouds is 10 % fast, so they arrive ever earlier by their stamps."""
    loop = Recorder(tmp_path)
    start = loop.stamps[0]
    for sweeps, lag in ((range(8), 0), (range(4), 8 * 10**8)):
        loop.clouds(sweeps, stamp=lambda stamp: stamp + (stamp - start) // 10, lag=lag)
    log = BagLog(loop.close())
    assert list(log.timestamps) == [start + k * 110_000_000 for k in range(8)]
    assert not [each for each in recwarn if "set back" in str(each.message)]


@pytest.mark.parametrize("unit", [1000, 1_000_000])
def test_stamps_of_a_smaller_unit_are_replaced(tmp_path, unit: int) -> None:
    """Microseconds and milliseconds that are written as nanoseconds; every other step is a little longer."""
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    bag.clouds(stamp=lambda stamp: (stamp + bag.stamps.index(stamp) % 2 * 10**6) // unit)
    with pytest.warns(CFlowWarning, match="so we use their times of arrival"):
        log = BagLog(bag.close())
    assert [time - 40_000_000 for time in log.timestamps] == list(bag.stamps)


def test_a_header_of_0_takes_the_time_of_arrival(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    bag.clouds(stamp=lambda stamp: 0 if stamp == bag.stamps[3] else stamp)
    log = BagLog(bag.close())
    late = [time - stamp for time, stamp in zip(log.timestamps, bag.stamps)]
    assert late == [40_000_000 * (index == 3) for index in range(8)]
    assert len(log.sweep(3).points) == len(bag.recording.units(3)[0].points)


def test_corrections_of_a_map_do_not_move_the_ego(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    for stamp in range(bag.stamps[0] - 10**8, bag.stamps[-1] + 10**8, 10**8):
        jump = np.eye(4)
        jump[0, 3] = 1.0 if stamp > bag.stamps[4] else 0.0
        bag.transform(stamp, "map", "odom", jump)
    bag.clouds()
    with pytest.warns(CFlowWarning, match="the transform from map to odom jumps, so poses are in odom"):
        log = BagLog(bag.close())
    assert world(log, bag.recording) < 5e-3


def test_of_two_parents_of_a_frame_the_one_with_more_samples_is_used(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    for stamp in bag.stamps:
        far = bag.recording.pose_at(stamp)
        far[:3, 3] += 100
        bag.transform(stamp, "map", "base_link", far)
    for parent in ("base_link", "velodyne", "velodyne"):
        bag.transform(bag.stamps[0], parent, "camera", np.eye(4))
    bag.clouds()
    with pytest.warns(
        CFlowWarning, match="several parents: we ignore the transforms that are rarer, map to base_link$"
    ):
        log = BagLog(bag.close())
    assert world(log, bag.recording) < 5e-3


def test_a_bad_transform_of_another_frame_stops_no_bag(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    bad = bag.writer.transform(bag.stamps[0], "base_link", "camera", np.eye(4))
    bad.transform.rotation.w = 1e3
    bag.writer.write("/tf", bag.stamps[0], TF, [bad])
    bag.clouds()
    assert world(BagLog(bag.close()), bag.recording) < 5e-3


@pytest.mark.parametrize("sweep", [1, 6, *(pytest.param(sweep, marks=pytest.mark.slow) for sweep in range(2, 6))])
def test_a_clock_that_is_set_back_runs_on(tmp_path, sweep: int) -> None:
    """The driver's clock, by NTP or PTP, anywhere in a recording."""
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    bag.clouds(stamp=lambda stamp: stamp - 330_000_000 * (stamp >= bag.stamps[sweep]))
    with pytest.warns(CFlowWarning, match=r"the clock of its clouds was set back by 0\.33 s"):
        log = BagLog(bag.close())
    assert list(log.timestamps) == list(bag.stamps) and world(log, bag.recording) < 5e-3


@pytest.mark.parametrize("sweep", [0, 5, *(pytest.param(sweep, marks=pytest.mark.slow) for sweep in range(1, 5))])
def test_a_message_that_arrives_after_the_next_one_keeps_its_time(tmp_path, sweep: int) -> None:
    """That before the last is not told from a clock that was set back."""
    late = Recorder(tmp_path)
    late.mount()
    late.drive()
    late.clouds(k for k in range(8) if k != sweep)
    late.clouds([sweep], lag=120_000_000)
    log = BagLog(late.close())
    assert list(log.timestamps) == list(late.stamps) and world(log, late.recording) < 5e-3


def test_a_bag_without_clouds_says_what_it_has(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.drive()
    with pytest.raises(CFlowError, match="it has no topic of type sensor_msgs/msg/PointCloud2; it has /tf"):
        BagLog(bag.close())


def test_a_gap_splits_windows(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.mount()
    bag.drive()
    bag.clouds([0, 1, 2, 7])
    with pytest.warns(CFlowWarning, match="1 gaps between sweeps .*0.5 s long, after sweep 2"):
        assert open_log("bags", bag.close()).gaps == {2}


@pytest.mark.parametrize(("has_odometry", "frames"), [(True, ["body"]), (False, ["body"]), (True, ["body", "camera"])])
def test_clouds_in_the_frame_of_the_world_are_moved_to_the_vehicle(tmp_path, has_odometry: bool, frames: Any) -> None:
    bag = Recorder(tmp_path)
    if has_odometry:
        bag.odometry("body", "camera_init")
    bag.registered(*frames)
    with pytest.warns(CFlowWarning, match="clouds are in camera_init, the frame of the world; we move them to body"):
        log = BagLog(bag.close())
    assert np.allclose(log.sweep(3).points, bag.recording.units(3)[0].points, atol=5e-3)
    assert np.allclose(log.poses[3], bag.recording.pose_at(bag.stamps[3]))


def test_of_two_frames_that_drive_in_the_frame_of_the_clouds_one_must_be_chosen(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.registered("body", "camera")
    path = bag.close()
    with pytest.warns(CFlowWarning, match=r"body, camera move in camera_init, .*frame \(data.frame\)"):
        assert BagLog(path).poses is None
    log = BagLog(path, frame="body")
    assert np.allclose(log.sweep(3).points, bag.recording.units(3)[0].points, atol=5e-3)


def test_the_frame_of_a_lidar_that_carries_base_link_is_not_that_of_the_world(tmp_path, recwarn) -> None:
    bag = Recorder(tmp_path)
    bag.transform(bag.stamps[0], "velodyne", "base_link", np.linalg.inv(MOUNT))
    for stamp in range(bag.stamps[0] - 10**8, bag.stamps[-1] + 10**8, STEP):
        bag.transform(stamp, "odom", "velodyne", bag.recording.pose_at(stamp) @ MOUNT)
    bag.clouds()
    log = BagLog(bag.close())
    assert log.frame == "base_link" and world(log, bag.recording) < 5e-3
    assert not [each for each in recwarn if "frame of the world" in str(each.message)]


def test_a_base_link_of_another_robot_is_not_the_vehicle(tmp_path) -> None:
    bag = Recorder(tmp_path)
    bag.transform(bag.stamps[0], "robot1/body", "velodyne", MOUNT)
    for stamp in range(bag.stamps[0] - 10**8, bag.stamps[-1] + 10**8, STEP):
        pose = bag.recording.pose_at(stamp)
        bag.transform(stamp, "map", "robot1/body", pose)
        bag.transform(stamp, "map", "robot2/base_link", as_matrix(np.eye(3), -2 * pose[:3, 3]))
    bag.clouds()
    log = BagLog(bag.close())
    assert log.frame == "robot1/body" and world(log, bag.recording) < 5e-3


LIVOX = {
    "CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line",
    "CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "livox_ros_driver2/CustomPoint[] points",
}


@pytest.mark.parametrize("form", ["ros1", "ros2"])
def test_custom_messages_of_livox_are_read(tmp_path, form: str) -> None:
    bag = Recorder(tmp_path, form)
    for name, definition in LIVOX.items():
        bag.writer.types.register(typesys.get_types_from_msg(definition, f"livox_ros_driver2/msg/{name}"))
    kinds = [f"livox_ros_driver2/msg/{name}" for name in LIVOX]
    for k, stamp in enumerate(bag.stamps):
        points = [
            bag.writer.make(kinds[0], 2_500_000 * row, *map(float, point), row, 0, 1)
            for row, point in enumerate([*bag.recording.units(k)[0].points, np.zeros(3)])
        ]
        header = bag.writer.header(stamp, "livox")
        bag.writer.write("/livox", stamp, kinds[1], header, stamp, len(points), 0, np.zeros(3, np.uint8), points)
    path = bag.close()
    for file in path.glob("*.db3"):  # ROS 2 Humble does not store definitions
        base = sqlite3.connect(file)
        if base.execute("SELECT name FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            base.execute("DELETE FROM message_definitions")
        base.commit()
        base.close()
    log = BagLog(path)
    assert np.allclose(log.sweep(2).points, bag.recording.units(2)[0].points, atol=1e-5)
    assert np.allclose(log.sweep(2).point_times, np.arange(40) * 2.5e-3)
    assert log.columns(2)["reflectivity"].tolist() == list(range(40))


def test_messages_that_are_not_decoded_name_their_converter(tmp_path) -> None:
    bag, kind = Recorder(tmp_path), "velodyne_msgs/msg/VelodyneScan"
    bag.writer.types.register(typesys.get_types_from_msg("std_msgs/Header header", kind))
    bag.writer.write("/packets", bag.stamps[0], kind, bag.writer.header(bag.stamps[0], "velodyne"))
    with pytest.raises(CFlowError, match="VelodyneScan, which we do not decode: convert it with velodyne_pointcloud"):
        BagLog(bag.close())


def test_unfinished_recordings_say_what_to_do(tmp_path) -> None:
    (tmp_path / "drive.bag.active").write_bytes(b"#ROSBAG V2.0\n")
    for path in (tmp_path, tmp_path / "drive.bag.active"):
        assert recognise(path) == "bags"
    (bag,) = find_bags(tmp_path)
    with pytest.raises(CFlowError, match="was not finished: run rosbag reindex"):
        BagLog(bag)


@pytest.mark.parametrize("missing", [0.0, np.inf, np.nan])
@pytest.mark.parametrize("order", "<>")
def test_a_wrong_byte_order_is_found(tmp_path, order: str, missing: float) -> None:
    writer, points = BagWriter(tmp_path, "ros1"), np.random.default_rng(0).normal(0, 20, (50, 3)).astype(np.float32)
    points[:20] = missing
    message: Any = SimpleNamespace(**vars(writer.make(CLOUD, *writer.cloud(0, points, None, order))))
    for message.is_bigendian in (False, True):
        assert np.array_equal(points_of(cloud_columns(message)).astype(np.float32), points[20:])


def test_a_cloud_of_no_usual_numbers_has_the_byte_order_that_it_states(tmp_path) -> None:
    writer = BagWriter(tmp_path, "ros1")
    message = writer.make(CLOUD, *writer.cloud(0, np.full((50, 3), 1e-9) * np.arange(1, 51)[:, None], None))
    assert np.abs(points_of(cloud_columns(message))).max() < 1e-6
