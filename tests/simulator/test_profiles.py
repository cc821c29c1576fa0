"""Sensor profiles and scenes: the shots of every LiDAR, motion during a sweep, and the truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from cflow_torch.simulator import make_drive
from cflow_torch.simulator.drive import SCENES, Drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.raycast import BOX
from cflow_torch.transforms import transform_points

KIND = {"nuscenes": "crossing", "truckscenes": "highway", "aevascenes": "highway"}


@pytest.fixture(scope="module")
def drives():
    return {name: make_drive(seed=3, num_sweeps=2, profile=name, scene=KIND.get(name, "street")) for name in PROFILES}


def exact(drive):
    profile = replace(drive._profile, range_noise=0.0)
    return Drive(drive.scene, profile, 0, len(drive.timestamps), "exact")


def at_shot(drive, index, unit):
    """(n, 3) float64 points of a unit in its own frame at the time of their shots, before any compensation."""
    points = unit.points.astype(float)
    spec = next(u for u in drive._profile.units if u.name == unit.name)
    if spec.is_virtual or not (drive._profile.is_rolling and drive._profile.is_deskewed):
        return points
    world = transform_points(points, drive.poses[index] @ unit.T_ego_sensor)
    T = np.linalg.inv(drive.poses_at(index, unit.offset_ns) @ unit.T_ego_sensor)
    return np.einsum("nij,nj->ni", T[:, :3, :3], world) + T[:, :3, 3]


def world_at_shot(drive, index, returns):
    """(n, 3) float64 world points of a sweep at the time of their shots."""
    points = returns.points.numpy().astype(float)
    if drive._profile.is_deskewed:
        return transform_points(points, drive.poses[index])
    T = drive.poses_at(index, returns.offset_ns.numpy())
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def on_boxes(drive, index, is_chosen):
    """Returns on boxes of the chosen bodies: rows, world points at the time of the shot, poses of the boxes at the time
    stamp, and a function that returns the distances of points from the faces of these boxes."""
    returns = drive.returns(index)
    solid, solids = returns.solid.numpy(), drive.scene.solids(drive._seconds[index], drive._body_poses[index])
    chosen = np.array([is_chosen(body) for body in drive.scene.bodies])[drive.scene.body_of_solid]
    rows = np.flatnonzero((solid >= 0) & np.append(chosen & (solids.kind.numpy() == BOX), False)[solid])
    pose = solids.pose.numpy()[solid[rows]]

    def distance(world):
        local = np.einsum("nji,nj->ni", pose[:, :3, :3], world - pose[:, :3, 3])
        return np.abs((np.abs(local) - solids.half_size.numpy()[solid[rows]]).max(1))

    return rows, world_at_shot(drive, index, returns)[rows], pose, distance


ALIKE = ("av2", "nuscenes", "truckscenes", "aevascenes")  # of these, other tests compare shots of one with brute force


@pytest.mark.parametrize(
    "name",
    [
        *(name for name in PROFILES if name not in ALIKE),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ALIKE),
    ],
)
def test_every_shot_is_on_its_ring_its_column_and_its_time(name, drives):
    drive = drives[name]
    units, sweep = drive.units(1), drive.sweep(1)
    together = np.concatenate([transform_points(unit.points, unit.T_ego_sensor) for unit in units])
    assert np.abs(together - sweep.points).max() < 1e-4 and len(drive.labels(0).flow) == len(drive.sweep(0).points)
    assert np.array_equal(np.concatenate([unit.offset_ns for unit in units]), drive.channels(1)["offset_ns"])
    near = sweep.is_ground & (np.hypot(*sweep.points[:, :2].T) < 14)
    assert near.sum() > 50 and abs(np.median(sweep.points[near, 2]) + drive._profile.ego_height) < 0.08
    interval, is_rolling = drive._profile.sweep_interval_ns, drive._profile.is_rolling
    for unit, spec in zip(units, drive._profile.units):
        assert (len(unit.elevations), unit.num_columns) == (len(spec.elevations), spec.num_columns) and len(
            unit.points
        ) > 300
        x, y, z = at_shot(drive, 1, unit).T
        distance = np.sqrt(x * x + y * y + z * z)
        assert np.abs(np.arcsin(z / distance) - unit.elevations[unit.ring]).max() < 1e-4
        sure = np.hypot(x, y) > 0.3 * distance
        starts = np.degrees(np.arctan2(y, x))[sure] - spec.span / spec.num_columns * (unit.column[sure] + 0.5)
        start = spec.start if is_rolling and not spec.has_jitter else starts[0]  # one start for all columns
        assert np.abs(starts - start - 360 * np.round((starts - start) / 360)).max() < 0.01
        if not is_rolling:
            assert not unit.offset_ns.any() and sweep.point_times is None
            continue
        phase = unit.offset_ns - unit.column * (interval / unit.num_columns) + drive._profile.reference * interval
        # Waymo's rear image wraps round.
        assert np.abs(phase - interval * np.round(phase / interval)).max() <= 1
        assert (np.diff(unit.offset_ns) >= 0).all()
    if is_rolling:
        assert np.array_equal(sweep.point_times, drive.channels(1)["offset_ns"] * 1e-9)


@pytest.mark.parametrize("name", ["nuscenes", "truckscenes", "waymo"])
def test_static_boxes_are_undistorted_after_deskewing_and_distorted_without(name, drives):
    drive = exact(drives[name])
    rows, world, _, distance = on_boxes(drive, 1, lambda body: body.is_static)
    assert len(rows) > 500 and np.quantile(distance(world), 0.999) < 1e-3
    given = distance(transform_points(drive.returns(1).points.numpy(), drive.poses[1])[rows])
    # The points of the truck, which drives at 80 km/h or more, are not compensated.
    assert np.quantile(given, 0.9) > 0.3 if name == "truckscenes" else np.quantile(given, 0.999) < 1e-3


def test_moving_objects_stay_distorted_and_boxes_hold_their_points(drives):
    """On a highway, the points of a car may be metres from its position at the time stamp."""
    drive = exact(make_drive(seed=3, num_sweeps=2, profile="nuscenes", scene="highway"))

    def is_even(body):
        return body.category == "REGULAR_VEHICLE" and not body.is_static and body.trajectory.acceleration == 0

    rows, world, pose, distance = on_boxes(drive, 1, is_even)
    speed = np.array([getattr(body.trajectory, "speed", 0.0) for body in drive.scene.bodies])
    along = speed[drive._body_of(drive.returns(1))[rows]] * 1e-9 * drive.returns(1).offset_ns.numpy()[rows]
    assert len(rows) > 300 and np.quantile(distance(world), 0.8) > 0.1
    assert np.quantile(distance(world - pose[:, :3, 0] * along[:, None]), 0.99) < 5e-3, "speed times time"
    for drive in drives.values():
        boxes, body = drive.boxes(1), drive._body_of(drive.returns(1))
        points = transform_points(world_at_shot(drive, 1, drive.returns(1)), np.linalg.inv(drive.poses[1]))
        number_of = {track: b for b, track in enumerate(drive.track_ids)}
        for track, pose, size, number in zip(boxes.track_id, boxes.pose, boxes.size, boxes.num_points):
            local = transform_points(points[body == number_of[track]], np.linalg.inv(pose))
            assert len(local) == number and (np.abs(local) <= size / 2 + 0.06).all()
        assert boxes.num_points.sum() > 1000


def test_the_truck_has_no_returns_of_itself_and_its_trailer_occludes(drives):
    drive = drives["truckscenes"]
    returns, points = drive.returns(0), drive.sweep(0).points
    hidden = drive.scene.body_of_solid >= len(drive.scene.bodies) - drive.scene.num_own
    assert drive.scene.num_own == 2 and not np.append(hidden, False)[returns.solid.numpy()].any()
    behind = (np.abs(points[:, 1]) < 1.0) & (points[:, 0] < -12) & (points[:, 0] > -60) & (returns.unit.numpy() < 2)
    ahead = (np.abs(points[:, 1]) < 1.0) & (points[:, 0] > 12) & (points[:, 0] < 60)
    assert ahead.sum() > 50 * max(behind.sum(), 1)
    down = drive.calibration["LIDAR_TOP_FRONT"][:3, 0]
    assert math.degrees(math.asin(-down[2])) == pytest.approx(56.0)


def test_weather_removes_distant_returns_first():
    distance = [
        np.linalg.norm(make_drive(1, 1, "nuscenes", weather=name).sweep(0).points, axis=1)
        for name in ("clear", "rain", "fog")
    ]
    near, far = ([np.count_nonzero(part) for part in parts] for parts in zip(*((d < 10, d > 60) for d in distance)))
    assert near[0] > near[1] and far[0] > far[1] > far[2]
    assert far[2] / far[0] < 0.4 and near[2] / near[0] > 0.9


SPEEDS = {"street": (15, 21), "highway": (28, 35.5), "crossing": (8, 15), "narrow": (4, 8), "car_park": (2, 6.5)}


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_have_their_traffic(scene):
    drive = make_drive(seed=2, num_sweeps=2, profile="av2", scene=scene)
    labels, points = drive.labels(0), drive.sweep(0).points.astype(float)
    static = transform_points(points, np.linalg.inv(drive.poses[1]) @ drive.poses[0]) - points
    speed, present = 10 * np.linalg.norm(labels.flow - static, axis=1), set(np.unique(labels.category))
    low, high = SPEEDS[scene]
    assert low < speed.max() < high and ((speed > 0.5) & (labels.category == 19)).sum() > 100
    assert present >= {0, 17, 19} | ({4} - {4 * (scene == "highway")})
    assert scene not in ("street", "highway") or {26, 27} <= present
    assert drive.log_id == ("synthetic-av2-0002" if scene == "street" else f"synthetic-av2-{scene}-0002")
