"""TruckScenes: several LiDARs with their own times, motion compensation, the truck itself, broken files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_recording import CAR_VELOCITY, TinyRecording
from writers.nuscenes import write_nuscenes
from writers.truckscenes import write_truckscenes

from cflow_torch.data.arrays.cloud_file import read_cloud, write_cloud
from cflow_torch.data.arrays.pcd import pcd_fields
from cflow_torch.data.nuscenes.reader import find_nuscenes_scenes
from cflow_torch.data.truckscenes import TruckScenesLog, find_truckscenes_scenes
from cflow_torch.transforms import transform_points
from cflow_torch.types import CFlowError

VERSION = "v1.2-mini"
UTM = (692_345.678, 5_336_789.012, 0.0)  # the world coordinates of the data set are of this size


def open_log(folder: Path, **settings: Any) -> TruckScenesLog:
    (source,) = find_truckscenes_scenes(folder)
    return TruckScenesLog(source, **settings)


def read(folder: Path, table: str) -> list:
    return json.loads((folder / VERSION / f"{table}.json").read_text())


def save(folder: Path, table: str, rows: list) -> None:
    (folder / VERSION / f"{table}.json").write_text(json.dumps(rows))


@pytest.fixture(scope="module")
def recording():
    return TinyRecording(("LIDAR_RIGHT", "LIDAR_LEFT", "LIDAR_REAR"), origin=UTM)


@pytest.fixture
def tiny(recording, tmp_path):
    return write_truckscenes(recording, tmp_path / "data")


@pytest.mark.parametrize("index", [0, 2, 5])
def test_each_shot_is_moved_with_the_pose_of_its_time(recording, tiny, index):
    """After the last pose the motion continues. World coordinates of 5e6 m have steps of 1e-9 m."""
    points = open_log(tiny, own_vehicle=None).sweep(index).points
    assert np.abs(points - transform_points(recording.world(index), np.linalg.inv(recording.poses[index]))).max() < 2e-5
    raw = open_log(tiny, own_vehicle=None, deskew=False).sweep(index).points
    assert np.abs(raw - recording.sweep(index).points).max() < 2e-5
    assert np.abs(raw - points).max() > 1


def test_times_of_points_count_from_the_stamp_of_the_sweep(recording, tiny):
    """Also those of LiDARs whose own sweeps have another stamp; the files have whole microseconds since 1970."""
    expected = np.concatenate([unit.offset_ns for unit in recording.units(2)]) * 1e-9
    times = open_log(tiny, own_vehicle=None).sweep(2).point_times
    assert np.abs(times - expected).max() < 2e-6 and np.ptp(expected) > 0.01
    assert open_log(tiny, own_vehicle=None, deskew=False).sweep(2).point_times is None


def test_flow_of_raw_sweeps_is_exact_for_constant_motion(recording, tiny):
    """A shot hits an object where its box is at that time, up to 2 m from its position at the time stamp."""
    log, on_car = open_log(tiny, own_vehicle=None), recording.is_on_car()
    for index in (0, 1, 3):
        labels = log.labels(index)
        world = recording.world(index) + np.where(on_car[:, None], 0.1 * CAR_VELOCITY, 0)
        arrive = transform_points(world, np.linalg.inv(recording.poses[index + 1]))
        assert np.array_equal(labels.category > 0, on_car) and labels.is_valid.all()
        assert np.abs(labels.flow - (arrive - log.sweep(index).points)).max() < 3e-5
    assert log.labels(5) is None


def test_lidars_have_their_own_times_and_poses(recording, tiny):
    """The right LiDAR is triggered 20 ms later, with the ego pose of that time, as in the data set."""
    right = [row["token"] for row in read(tiny, "calibrated_sensor")][0]
    sweeps, poses = read(tiny, "sample_data"), {row["token"]: row for row in read(tiny, "ego_pose")}
    for row in sweeps:
        if row["calibrated_sensor_token"] == right:
            row["timestamp"] += 20_000
            later = recording.pose_at(1000 * row["timestamp"])
            half = np.arctan2(later[1, 0], later[0, 0]) / 2
            pose = poses[row["ego_pose_token"]]
            pose.update(translation=later[:3, 3].tolist(), rotation=[np.cos(half), 0, 0, np.sin(half)])
    save(tiny, "sample_data", sweeps)
    save(tiny, "ego_pose", list(poses.values()))
    log = open_log(tiny, own_vehicle=None, deskew=False)
    assert list(log.timestamps) == [stamp // 1000 * 1000 for stamp in recording.timestamps]  # those of LIDAR_LEFT
    points, here = log.sweep(1).points, recording.sweep(1).points
    late = np.linalg.inv(recording.poses[1]) @ recording.pose_at(recording.timestamps[1] + 20_000_000)
    assert np.abs(points[40:] - here[40:]).max() < 2e-5
    assert np.abs(points[:40] - transform_points(here[:40], late)).max() < 3e-5
    assert np.abs(points[:40] - here[:40]).max() > 0.2
    skewless = open_log(tiny, own_vehicle=None).sweep(1).points  # the same points, because shots have their own times
    assert np.abs(skewless - transform_points(recording.world(1), np.linalg.inv(recording.poses[1]))).max() < 2e-5


def test_a_lidar_without_a_sweep_in_time_is_left_out(recording, tiny):
    """Its neighbouring sweeps are 100 ms away, so we do not use them."""
    sweeps = read(tiny, "sample_data")
    rear = read(tiny, "calibrated_sensor")[2]["token"]
    chain = [row for row in sweeps if row["calibrated_sensor_token"] == rear]
    chain[1]["next"], chain[3]["prev"] = chain[3]["token"], chain[1]["token"]
    save(tiny, "sample_data", [row for row in sweeps if row is not chain[2]])
    log = open_log(tiny, own_vehicle=None)
    assert [len(log.sweep(index).points) for index in range(4)] == [120, 120, 80, 120]
    only = open_log(tiny, own_vehicle=None, lidars=["LIDAR_REAR"])
    assert len(only) == 5 and len(only.sweep(0).points) == 40


def test_truck_and_trailer_are_removed(recording, tiny):
    """|x| < 7 m and |y| < 2 m, and the box of the trailer; both in the ego frame of the shot."""
    log = open_log(tiny, lidars=["LIDAR_LEFT"])
    file = next((tiny / "samples" / "LIDAR_LEFT").glob(f"*_{log.timestamps[0] // 1000}.pcd"))
    inside = np.array([[6.9, 1.9, 1], [-6.9, -1.9, 3], [7.1, 0, 1], [0, 2.1, 1], [-20, 12, 1.2], [-20, 16, 1.2]])
    mount = recording.units(0)[1].T_ego_sensor
    local = transform_points(inside, np.linalg.inv(mount)).astype(np.float32)
    local = np.concatenate([local, np.zeros((1, 3)), np.full((1, 3), np.nan)]).astype(np.float32)
    # 99 ms later the truck has moved by 1.5 m, but not relative to itself.
    times = np.full(len(local), log.timestamps[0] // 1000 + 99_000, np.uint64)
    write_cloud(file, local, {"intensity": np.zeros(len(local), np.float32), "timestamp": times})
    assert len(log.sweep(0).points) == 4
    assert len(open_log(tiny, lidars=["LIDAR_LEFT"], own_vehicle=None).sweep(0).points) == 6
    names = read(tiny, "category")
    for row in names:
        row["name"] = row["name"].replace("vehicle.truck", "vehicle.ego_trailer")  # the parked one at (-20, 12)
    save(tiny, "category", names)
    masked = open_log(tiny, lidars=["LIDAR_LEFT"])
    assert len(masked.sweep(0).points) == 3 and len(masked.labels(0).flow) == 3
    assert len(open_log(tiny, lidars=["LIDAR_LEFT"], own_vehicle=None).sweep(0).points) == 6


def test_a_bad_sweep_costs_no_other(recording, tiny):
    log = open_log(tiny)
    file = next((tiny / "samples" / "LIDAR_LEFT").glob(f"*_{log.timestamps[0] // 1000}.pcd"))
    points, times = read_cloud(file), pcd_fields(file.read_bytes())["timestamp"]
    for columns, complaint in [
        ({}, r"lacks the columns \['timestamp'\]"),
        ({"timestamp": times - times.min()}, "microseconds since 1970.* deskew=False"),
        ({"timestamp": times * np.uint64(1000)}, "microseconds since 1970.* deskew=False"),
    ]:
        write_cloud(file, points, columns)
        with pytest.raises(CFlowError, match=f"{file.name}.*{complaint}"):
            log.sweep(0)
    assert len(log.sweep(1).points) > 0


def test_the_other_data_set_is_refused_or_skipped(tiny, tmp_path):
    with pytest.raises(CFlowError, match="is not nuScenes: .* choose the other reader"):
        find_nuscenes_scenes(tiny)
    other = write_nuscenes(TinyRecording(), tmp_path / "other")
    with pytest.raises(CFlowError, match="is not TruckScenes: .* choose the other reader"):
        find_truckscenes_scenes(other)
    assert [source.root for source in find_truckscenes_scenes(tmp_path)] == [tiny]
