"""Sensor profiles and scenes: the shots of every LiDAR, what moves while they turn, and truth under all that."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from test_synthetic import brute_force, transform

from cflow_torch.simulator import make_drive
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.objects import Body, Route
from cflow_torch.simulator.profiles import PROFILES, WEATHER, in_weather
from cflow_torch.simulator.range_image import cast_shots
from cflow_torch.simulator.raycast import BOX
from cflow_torch.simulator.rolling import Shots
from cflow_torch.simulator.scenes import SCENES
from cflow_torch.types import CFlowError

ROLLING = [name for name, profile in PROFILES.items() if profile.is_rolling]


@pytest.fixture(scope="module")
def drives():
    """Two sweeps of each rolling profile, scene by scene different."""
    scenes = {"nuscenes": "crossing", "truckscenes": "highway", "waymo": "street", "aevascenes": "highway"}
    return {name: make_drive(seed=3, num_sweeps=2, profile=name, scene=scenes.get(name, "street")) for name in ROLLING}


def exact(drive, **changes):
    """The drive without noise of any kind."""
    profile = replace(drive._profile, range_noise=0.0, velocity_noise=0.0, **changes)
    return Drive(drive.scene, profile, 0, len(drive.timestamps), "exact")


def at_shot(drive, index, unit):
    """(n, 3) float64 points of a unit in its own frame when it fired, whatever the data set did to them since."""
    points = unit.points.astype(float)
    spec = next(u for u in drive._profile.units if u.name == unit.name)
    if spec.is_virtual or not (drive._profile.is_rolling and drive._profile.is_deskewed):
        return points
    world = transform(drive.poses[index] @ unit.T_ego_sensor, points)
    T = np.linalg.inv(drive.poses_at(index, unit.offset_ns) @ unit.T_ego_sensor)
    return np.einsum("nij,nj->ni", T[:, :3, :3], world) + T[:, :3, 3]


def where_it_was(drive, index, returns):
    """(n, 3) float64 world points of a sweep at the time of their shots."""
    points = returns.points.numpy().astype(float)
    if drive._profile.is_deskewed:
        return transform(drive.poses[index], points)
    T = drive.poses_at(index, returns.offset_ns.numpy())
    return np.einsum("nij,nj->ni", T[:, :3, :3], points) + T[:, :3, 3]


def off_the_boxes(drive, world, solid, pose):
    """(n,) metres from the surface of the box (solid number) that each world point should lie on."""
    half = drive.scene.table.half[solid]
    local = np.einsum("nji,nj->ni", pose[solid, :3, :3], world - pose[solid, :3, 3])
    return np.abs((np.abs(local) - half).max(1))


EXPECTED = {
    # units with rings and columns; sweep interval, first and last shot, ms; points; height of the ego frame
    "av2": ({"up_lidar": (32, 1800), "down_lidar": (32, 1800)}, 100, (0, 100), (60_000, 115_200), 0.35),
    "av2_rolling": ({"up_lidar": (32, 1800), "down_lidar": (32, 1800)}, 100, (0, 100), (60_000, 115_200), 0.35),
    "demo": ({"up_lidar": (32, 900)}, 100, (0, 100), (15_000, 28_800), 0.35),
    "nuscenes": ({"LIDAR_TOP": (32, 1084)}, 50, (-50, 0), (20_000, 34_688), 0.0),
    "truckscenes": (
        {
            **{f"LIDAR_{name}": (64, 1800) for name in ("LEFT", "RIGHT")},
            **{f"LIDAR_{name}": (32, 1024) for name in ("TOP_FRONT", "TOP_LEFT", "TOP_RIGHT", "REAR")},
        },
        *(100, (12, 88), (80_000, 240_000), 0.0),
    ),
    "waymo": (
        {"TOP": (64, 2650), **dict.fromkeys(("FRONT", "SIDE_LEFT", "SIDE_RIGHT", "REAR"), (200, 600))},
        *(100, (-63, 50), (100_000, 200_000), 0.0),
    ),
    "aevascenes": (
        {
            **{f"{name}_lidar": (100, 800) for name in ("front_wide", "right", "rear_wide", "left")},
            **{f"{name}_lidar": (80, 700) for name in ("front_narrow", "rear_narrow")},
        },
        *(100, (0, 100), (150_000, 432_000), 0.35),
    ),
}


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_has_the_lidars_of_its_data_set(name, drives):
    sizes, interval_ms, (first, last), (few, many), height = EXPECTED[name]
    drive = drives.get(name) or make_drive(seed=3, num_sweeps=2, profile=name)
    units = {unit.name: unit for unit in drive.units(1)}
    assert {n: (u.num_rings, u.num_columns) for n, u in units.items()} == sizes
    assert np.diff(drive.timestamps).tolist() == [interval_ms * 1_000_000]
    for unit in units.values():
        elevation = drive.elevations(unit.name)
        assert len(elevation) == unit.num_rings and (np.diff(elevation) > 0).all()
        assert unit.ring.min() >= 0 and unit.ring.max() < unit.num_rings
        assert unit.column.min() >= 0 and unit.column.max() < unit.num_columns
        assert unit.offset_ns.dtype == np.int64 and unit.points.dtype == np.float32
        assert np.allclose(unit.T_ego_sensor[:3, :3] @ unit.T_ego_sensor[:3, :3].T, np.eye(3), atol=1e-12)
    times = np.concatenate([unit.offset_ns for unit in units.values()]) * 1e-6
    assert first <= times.min() < first + 5 and last - 5 < times.max() <= last
    sweep = drive.sweep(1)
    assert few < len(sweep.points) < many
    near = sweep.is_ground & (np.hypot(*sweep.points[:, :2].T) < 14)
    assert near.sum() > 50 and abs(np.median(sweep.points[near, 2]) + height) < 0.08


@pytest.mark.parametrize("name", PROFILES)
def test_units_put_together_are_the_sweep(name, drives):
    drive = drives.get(name) or make_drive(seed=3, num_sweeps=2, profile=name)
    units, sweep, channels = drive.units(0), drive.sweep(0), drive.channels(0)
    assert list(drive.calibration) == [unit.name for unit in units]
    points = np.concatenate([transform(unit.T_ego_sensor, unit.points.astype(float)) for unit in units])
    assert points.shape == sweep.points.shape and np.abs(points - sweep.points).max() < 1e-4
    assert np.array_equal(np.concatenate([unit.intensity for unit in units]), channels.intensity)
    assert np.array_equal(np.concatenate([unit.offset_ns for unit in units]), channels.offset_ns)
    assert len(drive.labels(0).flow) == len(points)


@pytest.mark.parametrize("name", PROFILES)
def test_every_shot_is_on_its_ring_its_column_and_its_time(name, drives):
    drive = drives.get(name) or make_drive(seed=3, num_sweeps=2, profile=name)
    for unit, spec in zip(drive.units(1), drive._profile.units):
        x, y, z = at_shot(drive, 1, unit).T
        distance = np.sqrt(x * x + y * y + z * z)
        assert np.abs(np.arcsin(z / distance) - drive.elevations(unit.name)[unit.ring]).max() < 1e-4
        step = spec.span / spec.num_columns
        sure = np.hypot(x, y) > 0.3 * distance
        turned = np.degrees(np.arctan2(y, x))[sure] - step * unit.column[sure]
        turned = turned - turned[0] - 360 * np.round((turned - turned[0]) / 360)
        assert np.abs(turned).max() < 0.01  # one start for all columns
        if not spec.has_jitter and drive._profile.is_rolling:
            start = np.degrees(np.arctan2(y, x))[sure] - step * (unit.column[sure] + 0.5) - spec.start
            assert np.abs(start - 360 * np.round(start / 360)).max() < 0.01
        if drive._profile.is_rolling:
            assert (np.diff(unit.offset_ns) >= 0).all()
        interval = drive._profile.sweep_interval_ns
        phase = unit.offset_ns - unit.column * (interval / unit.num_columns) + drive._profile.reference * interval
        # Waymo's rear image wraps round; instantaneous profiles count in float32.
        off = np.abs(phase - interval * np.round(phase / interval)).max()
        assert off <= (1 if drive._profile.is_rolling else 8)


def test_nuscenes_looks_right_and_forward_and_waymo_s_grid_is_the_vehicle_s(drives):
    T = drives["nuscenes"].calibration["LIDAR_TOP"]
    assert np.allclose(T[:3, 0], (0, -1, 0)) and np.allclose(T[:3, 1], (1, 0, 0)) and T[2, 3] == 1.84023
    assert drives["nuscenes"].elevations("LIDAR_TOP")[[0, -1]] == pytest.approx(np.radians([-30.67, 10.67]))
    for unit in drives["waymo"].units(0):
        # The azimuth of a column is counted from the vehicle's, whatever way the sensor is turned.
        points = at_shot(drives["waymo"], 0, unit) @ unit.T_ego_sensor[:3, :3].T
        sure = np.hypot(*points[:, :2].T) > 1.0
        azimuth = ((unit.num_columns - unit.column[sure] - 0.5) / unit.num_columns * 2 - 1) * math.pi
        off = np.arctan2(points[sure, 1], points[sure, 0]) - azimuth
        assert np.abs(off - 2 * math.pi * np.round(off / (2 * math.pi))).max() < 1e-4
    down = drives["truckscenes"].calibration["LIDAR_TOP_FRONT"][:3, 0]
    assert math.degrees(math.asin(-down[2])) == pytest.approx(56.0)


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name not in ("av2_rolling", "nuscenes"))) for name in ROLLING],
)
def test_rolling_shots_equal_brute_force(name, drives):
    """Every ray at its own time, from where its LiDAR then is, against every solid where that then is."""
    drive, rng = drives[name], np.random.default_rng(0)
    profile, seconds = drive._profile, float(drive._seconds[1])
    ego, solids = drive._motion.ego_motion(seconds), drive._motion.solids(1)
    others = np.append(drive.scene.table.body < len(drive.scene.bodies) - drive.scene.num_own, True)  # last: ground
    checked = wrong = wrong_solid = 0
    for number, unit in enumerate(profile.units):
        first, end = unit.seen or (0, unit.num_columns)
        T_world_sensor = ego.T_world_unit[number].clone()
        T_world_sensor[:, :3, 3] -= solids.origin
        azimuth = np.radians(unit.start + unit.span / unit.num_columns * (np.arange(first, end) + 0.5))
        elevation = torch.from_numpy(drive.elevations(unit.name))
        speed = (0.0, 0.0) if unit.is_virtual else ego.speed
        shots = Shots(torch.from_numpy(azimuth), ego.seconds[number], T_world_sensor, elevation, speed)
        max_range = unit.max_range or profile.max_range
        image, _ = cast_shots(shots, solids, drive.scene.ground, max_range)
        distance, solid = (values.view(len(azimuth), -1).numpy() for values in (image.distance, image.solid))
        for column in (0, len(azimuth) - 1, *rng.integers(0, len(azimuth), 1 + 12 // len(profile.units))):
            now = float(ego.seconds[number][column])
            there = drive.scene.solids(now, drive.scene.body_poses(np.array([now]))[0])
            up = elevation.numpy()
            ray = np.stack([np.cos(azimuth[column]) * np.cos(up), np.sin(azimuth[column]) * np.cos(up), np.sin(up)])
            T = ego.T_world_unit[number][column].numpy()
            with np.errstate(all="ignore"):
                ranges = brute_force(there, T[:3, 3], T[:3, :3] @ ray)
            ground, _ = drive.scene.ground.cast(torch.from_numpy(T[:3, 3].copy()), torch.from_numpy(T[:3, :3] @ ray))
            nearest = np.minimum(ranges.min(0), ground.numpy())
            who = np.where(ground.numpy() < ranges.min(0), -1, ranges.argmin(0))
            in_reach = (nearest < max_range) & others[who]  # the truck's own trailer is interpolated to millimetres
            agree = np.isclose(distance[column], nearest, rtol=0, atol=2e-3)
            checked, wrong = checked + in_reach.sum(), wrong + (in_reach & ~agree).sum()
            wrong_solid += (in_reach & agree & (solid[column] != who)).sum()
    assert checked > 200 and wrong <= 0.002 * checked and wrong_solid <= 0.01 * checked


@pytest.mark.parametrize("name", ROLLING)
def test_the_static_world_stays_put_after_deskewing_and_only_then(name, drives):
    drive = exact(drives[name])
    returns = drive.returns(1)
    still = drive.scene.solids(0.0, drive.scene.body_poses(np.zeros(1))[0])
    stands = np.array([body.stands for body in drive.scene.bodies])[drive.scene.table.body]
    solid = returns.solid.numpy()
    rows = np.flatnonzero((solid >= 0) & np.append(stands & (drive.scene.table.kind == BOX), False)[solid])
    assert len(rows) > 500
    deskewed = where_it_was(drive, 1, returns)[rows]
    off = off_the_boxes(drive, deskewed, solid[rows], still.pose.numpy())
    assert np.quantile(off, 0.999) < 1e-3
    as_given = transform(drive.poses[1], returns.points.numpy().astype(float))[rows]
    given_off = off_the_boxes(drive, as_given, solid[rows], still.pose.numpy())
    if name == "truckscenes":
        assert np.quantile(given_off, 0.9) > 0.3  # raw: a truck at 80 km/h and more
    else:
        assert np.quantile(given_off, 0.999) < 1e-3


@pytest.mark.parametrize("name", ["nuscenes", "aevascenes", "waymo"])
def test_what_moves_stays_smeared(name):
    """On a highway a car is where it was when it was hit, metres from where it is at the time stamp."""
    drive = exact(make_drive(seed=3, num_sweeps=2, profile=name, scene="highway"))
    returns = drive.returns(1)
    solid, table = returns.solid.numpy(), drive.scene.table
    moves = np.array([not body.stands and body.category == "REGULAR_VEHICLE" for body in drive.scene.bodies])
    rows = np.flatnonzero((solid >= 0) & np.append(moves[table.body] & (table.kind == BOX), False)[solid])
    assert len(rows) > 300
    world = where_it_was(drive, 1, returns)[rows]
    stamped = drive.scene.solids(drive._seconds[1], drive._body_poses[1]).pose.numpy()
    late = drive._seconds[1] + 1e-9 * returns.offset_ns.numpy()[rows]
    # Straight roads: all of a car moves by speed times time.
    speed = np.array([getattr(body.way, "speed", 0.0) for body in drive.scene.bodies])[table.body[solid[rows]]]
    ahead = stamped[solid[rows], :3, 0]
    unsmeared = world - ahead * (speed * (late - drive._seconds[1]))[:, None]
    constant = np.array([getattr(b.way, "acceleration", 0.0) == 0 for b in drive.scene.bodies])[table.body[solid[rows]]]
    assert np.quantile(off_the_boxes(drive, unsmeared, solid[rows], stamped)[constant], 0.99) < 5e-3
    assert np.quantile(off_the_boxes(drive, world, solid[rows], stamped), 0.8) > 0.1


@pytest.mark.parametrize("name", ROLLING)
def test_truth_is_the_motion_of_the_body_between_the_time_stamps(name, drives):
    drive = drives[name]
    returns, labels, points = drive.returns(0), drive.labels(0), drive.sweep(0).points.astype(float)
    body, checked = drive._body_of(returns), 0
    to_next = np.linalg.inv(drive.poses[1])
    for b in np.unique(body):
        rows = body == b
        motion = to_next @ drive.poses[0]
        if b < len(drive.scene.bodies) and drive._category[b]:
            way = drive.scene.bodies[b].way
            pose0, pose1 = (drive.scene.ground.pose(*way(drive._seconds)[k : k + 1].T)[0] for k in (0, 1))
            motion = to_next @ pose1 @ np.linalg.inv(pose0) @ drive.poses[0]
            checked += rows.sum()
        assert np.abs(transform(motion, points[rows]) - points[rows] - labels.flow[rows]).max() < 3e-3
    assert checked > 1000


@pytest.mark.parametrize("name", ["nuscenes", "waymo", "aevascenes"])
def test_smeared_movers_land_on_the_next_sweep(name):
    """Those that go with the ego car: oncoming ones are swept at ever other times, and so smeared differently."""
    drive = make_drive(seed=4, num_sweeps=3, profile=name, scene="highway")
    body = [drive._body_of(drive.returns(i)) for i in (1, 2)]
    points = [drive.sweep(i).points.astype(float) for i in (1, 2)]
    labels, checked = drive.labels(1), 0
    for b, thing in enumerate(drive.scene.bodies):
        rows, target = body[0] == b, body[1] == b
        goes_along = not thing.stands and abs(drive._body_poses[1, b, 1, 0]) < 0.1 and drive._body_poses[1, b, 0, 0] > 0
        if goes_along and min(rows.sum(), target.sum()) > 100:
            landed = np.median(cKDTree(points[1][target]).query(points[0][rows] + labels.flow[rows])[0])
            assert landed < 0.12, thing.category
            checked += 1
    assert checked >= 2


@pytest.mark.parametrize("name", ["av2", "nuscenes", "aevascenes"])
def test_radial_velocity_is_the_derivative_of_the_range(name):
    """A mark on the thing that was hit, seen from where the LiDAR was: its range before and after."""
    drive = exact(make_drive(seed=5, num_sweeps=2, profile=name))
    returns, velocity = drive.returns(1), np.concatenate([unit.radial_velocity for unit in drive.units(1)])
    solid = returns.solid.numpy()
    assert (velocity[solid < 0] == 0).all() and np.abs(velocity).max() > 5
    world = where_it_was(drive, 1, returns)
    rows = np.random.default_rng(0).choice(np.flatnonzero(velocity != 0), 40)
    mounts = np.stack([unit.T_ego_sensor for unit in drive._profile.units])
    offset = returns.offset_ns.numpy() * (1 if drive._profile.is_rolling else 0)
    step = 1e-3
    for row in rows:
        sensor = (drive.poses_at(1, offset[row : row + 1])[0] @ mounts[returns.unit[row]])[:3, 3]
        seconds = drive._seconds[1] + 1e-9 * offset[row]
        times = seconds + np.array([-step, 0.0, step])
        bodies = drive.scene.body_poses(times)
        poses = [drive.scene.solids(t, p).pose.numpy()[solid[row]] for t, p in zip(times, bodies)]
        mark = np.linalg.inv(poses[1]) @ np.append(world[row], 1)
        before, after = (np.linalg.norm((pose @ mark)[:3] - sensor) for pose in (poses[0], poses[2]))
        assert velocity[row] == pytest.approx((after - before) / (2 * step), abs=0.02)


def test_aeva_velocities_are_noisy_and_others_exact():
    drive = make_drive(seed=5, num_sweeps=1, profile="aevascenes")
    returns, velocity = drive.returns(0), np.concatenate([unit.radial_velocity for unit in drive.units(0)])
    still = velocity[returns.solid.numpy() < 0]
    assert still.std() == pytest.approx(0.1, rel=0.05) and abs(still.mean()) < 0.005
    again = np.concatenate([unit.radial_velocity for unit in drive.units(0)])
    assert np.array_equal(again, velocity)


@pytest.mark.parametrize("name", ROLLING)
def test_boxes_hold_their_smeared_points(name, drives):
    drive = drives[name]
    boxes, returns = drive.boxes(1), drive.returns(1)
    points = transform(np.linalg.inv(drive.poses[1]), where_it_was(drive, 1, returns))
    body = drive._body_of(returns)
    names = {track: b for b, track in enumerate(drive.track_ids)}
    for track, pose, size, number in zip(boxes.track_id, boxes.pose, boxes.size, boxes.num_points):
        local = transform(np.linalg.inv(pose), points[body == names[track]])
        assert len(local) == number and (np.abs(local) <= size / 2 + 0.06).all()
        assert (np.abs(local[:, :2]) <= size[:2] / 2).all()
    assert boxes.num_points.sum() > 1000


@pytest.mark.parametrize("name", ["nuscenes", "truckscenes"])
def test_same_seed_same_bytes_in_any_order(name):
    first, second = (make_drive(seed=7, num_sweeps=2, profile=name, scene="narrow") for _ in range(2))
    ahead = [first.sweep(i).points.tobytes() for i in (0, 1)]
    assert ahead == [second.sweep(i).points.tobytes() for i in (1, 0)][::-1]
    assert first.labels(0).flow.tobytes() == second.labels(0).flow.tobytes()
    assert make_drive(seed=8, num_sweeps=1, profile=name, scene="narrow").sweep(0).points.tobytes() != ahead[0]


def test_the_truck_does_not_see_itself_and_its_trailer_hides_things(drives):
    drive = drives["truckscenes"]
    returns, points = drive.returns(0), drive.sweep(0).points
    hidden = drive.scene.table.body >= len(drive.scene.bodies) - drive.scene.num_own
    assert drive.scene.num_own == 2 and not np.append(hidden, False)[returns.solid.numpy()].any()
    behind = (np.abs(points[:, 1]) < 1.0) & (points[:, 0] < -12) & (points[:, 0] > -60) & (returns.unit.numpy() < 2)
    ahead = (np.abs(points[:, 1]) < 1.0) & (points[:, 0] > 12) & (points[:, 0] < 60)
    assert ahead.sum() > 50 * max(behind.sum(), 1)


def test_weather_takes_returns_the_far_ones_first():
    clear, rain, fog = (make_drive(1, 1, "nuscenes", weather=name) for name in ("clear", "rain", "fog"))
    distance = [np.linalg.norm(drive.sweep(0).points, axis=1) for drive in (clear, rain, fog)]
    near, far = ([np.count_nonzero(part) for part in parts] for parts in zip(*((d < 10, d > 60) for d in distance)))
    assert near[0] > near[1] and far[0] > far[1] > far[2]
    assert far[2] / far[0] < 0.4 and near[2] / near[0] > 0.9
    assert fog.log_id == "synthetic-nuscenes-fog-0001"
    assert all(0 <= in_weather(PROFILES["waymo"], name).units[1].dropout < 1 for name in WEATHER)


SPEEDS = {"street": (15, 21), "highway": (28, 35.5), "crossing": (8, 15), "narrow": (4, 8), "car_park": (2, 6.5)}


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_have_their_traffic(scene):
    drive = make_drive(seed=2, num_sweeps=2, profile="av2", scene=scene)
    labels, points = drive.labels(0), drive.sweep(0).points.astype(float)
    static = transform(np.linalg.inv(drive.poses[1]) @ drive.poses[0], points) - points
    speed = 10 * np.linalg.norm(labels.flow - static, axis=1)
    low, high = SPEEDS[scene]
    assert low < speed.max() < high
    assert {0, 17, 19} <= set(np.unique(labels.category)) and ((speed > 0.5) & (labels.category == 19)).sum() > 100
    if scene != "highway":
        assert 4 in labels.category
    if scene in ("street", "highway"):
        assert {26, 27} <= set(np.unique(labels.category))
    assert drive.log_id == ("synthetic-av2-0002" if scene == "street" else f"synthetic-av2-{scene}-0002")


@pytest.mark.parametrize("scene", SCENES)
def test_traffic_of_every_scene_starts_without_collisions(scene):
    """Footprints at time 0, by separating axes; a cab and its trailer share the hitch, people may stand close."""
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    for seed in range(4):
        place = SCENES[scene](np.random.default_rng([seed, 0]))
        bodies = [*(b for b in place.bodies if b.category), Body([], place.ego, "EGO", (4.8, 1.9, 1.6))]
        ways = np.stack([b.way(np.zeros(1))[0] for b in bodies])
        ways[-1, :2] += 1.4 * np.array([np.cos(ways[-1, 2]), np.sin(ways[-1, 2])])  # rear axle to middle
        axes = np.stack([[np.cos(ways[:, 2]), np.sin(ways[:, 2])], [-np.sin(ways[:, 2]), np.cos(ways[:, 2])]])
        axes = axes.transpose(2, 0, 1)
        corners = ways[:, None, :2] + np.einsum("ck,mk,mkx->mcx", signs, np.array([b.size[:2] for b in bodies]), axes)
        spans, own = np.einsum("mcx,nkx->mnkc", corners, axes), np.einsum("mcx,mkx->mkc", corners, axes)
        apart = ((spans.max(-1) < own.min(-1)[None]) | (spans.min(-1) > own.max(-1)[None])).any(-1)
        pairs = np.argwhere(~(apart | apart.T))
        found = {tuple(sorted((bodies[i].category, bodies[j].category))) for i, j in pairs if i < j}
        assert found <= {("TRUCK_CAB", "VEHICULAR_TRAILER"), ("PEDESTRIAN", "PEDESTRIAN")}, seed


def test_things_appear_from_behind_others():
    """Cars behind the corner houses, people behind a bus: out of sight, not out of reach, then seen."""
    for scene, category in (("crossing", "REGULAR_VEHICLE"), ("street", "PEDESTRIAN")):
        drive = make_drive(seed=2, num_sweeps=16, profile="waymo", scene=scene)
        number = len(drive.scene.bodies)
        before, after = (np.bincount(drive._body_of(drive.returns(i)), minlength=number + 1)[:-1] for i in (0, 15))
        distance = np.linalg.norm(drive._body_poses[0, :, :2, 3] - drive.poses[0, :2, 3], axis=1)
        chosen = np.array([body.category == category for body in drive.scene.bodies])
        assert (chosen & (before == 0) & (distance < 50) & (after > 40)).any()


def test_what_brakes_slows_down_and_stops():
    way = Route(0.0, 0.0, speed=4.0, acceleration=-2.0)
    x = way(np.array([0.0, 1.0, 2.0, 3.0]))[:, 0]
    assert np.allclose(x, [0, 3, 4, 4]) and not way.stands
    start = Route(0.0, 0.0, speed=2.0, acceleration=1.0)
    assert np.allclose(start(np.array([-3.0, -2.0, 0.0, 2.0]))[:, 0], [-2, -2, 0, 6])
    reverse = Route(0.0, 0.0, speed=-1.0)
    assert np.allclose(reverse(np.array([0.0, 2.0]))[:, 0], [0, -2])


@pytest.mark.parametrize("wrong", [{"scene": "moon"}, {"weather": "hail"}, {"profile": "radar"}])
def test_wrong_names_are_refused(wrong):
    with pytest.raises(CFlowError, match="choose one of"):
        make_drive(**wrong)


def test_a_missing_unit_is_refused(drives):
    with pytest.raises(CFlowError, match="LIDAR_TOP"):
        drives["nuscenes"].elevations("FRONT")
