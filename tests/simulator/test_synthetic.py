"""Simulated drives: rays equal brute force, truth agrees with the next sweep, seeds are reproducible."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from cflow_torch.simulator import make_drive, raycast
from cflow_torch.simulator.drive import SCENES, Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.lidar import scan
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.range_image import cast_shots, cast_solids
from cflow_torch.simulator.raycast import BOX, CYLINDER, ELLIPSOID, Solids, ray_directions
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.trajectories import Route, Towed
from cflow_torch.transforms import transform_points
from cflow_torch.types import CFlowError


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=3, num_sweeps=5, profile="av2")


def brute_force(solids, origin, directions):
    """Ranges (P, R) of one ray after another, float64, straight from the definitions of the unit solids."""
    ranges = np.full((len(solids.kind), directions.shape[1]), np.inf)
    for p, (kind, pose, half) in enumerate(zip(solids.kind, solids.pose.numpy(), solids.half_size.numpy())):
        to_unit = np.linalg.inv(pose)
        o = (to_unit[:3, :3] @ origin + to_unit[:3, 3]) / half
        d = (to_unit[:3, :3] @ directions) / half[:, None]
        low, high = np.full(d.shape[1], -np.inf), np.full(d.shape[1], np.inf)
        with np.errstate(all="ignore"):
            for k in {BOX: (0, 1, 2), CYLINDER: (2,), ELLIPSOID: ()}[int(kind)]:
                ends = np.sort(np.stack([(-1 - o[k]) / d[k], (1 - o[k]) / d[k]]), axis=0)
                low, high = np.maximum(low, ends[0]), np.minimum(high, ends[1])
            round_axes = {BOX: 0, CYLINDER: 2, ELLIPSOID: 3}[int(kind)]
            if round_axes:
                o, d = o[:round_axes], d[:round_axes]
                a, b, c = (d * d).sum(0), (o[:, None] * d).sum(0), (o * o).sum() - 1
                root = np.sqrt(b * b - a * c)
                low, high = np.fmax(low, (-b - root) / a), np.fmin(high, (-b + root) / a)
                high[np.isnan(root)] = -np.inf
        hit = (low <= high) & (low > 0)
        ranges[p, hit] = low[hit]
    return ranges


def random_solids(rng, number):
    """Solids of all kinds with random rotations, none around the origin; one long wall, one beam overhead."""
    pose = np.tile(np.eye(4), (number, 1, 1))
    pose[:, :3, :3] = np.linalg.qr(rng.normal(size=(number, 3, 3)))[0]
    pose[:, :3, :3] *= np.linalg.det(pose[:, :3, :3])[:, None, None]
    pose[:, :3, 3] = rng.uniform(-30, 30, (number, 3)) * (1, 1, 0.2)
    half, kind = rng.uniform(0.05, 1.5, (number, 3)), rng.integers(0, 3, number)
    pose[0, :3, :3], pose[0, :3, 3], half[0], kind[0] = np.eye(3), (0, 4, 0), (40, 0.1, 2), BOX
    pose[1, :3, :3], pose[1, :3, 3], half[1], kind[1] = np.eye(3), (0, 0, 3), (5, 5, 0.1), BOX
    keep = np.linalg.norm(pose[:, :3, 3], axis=1) > 2.9
    kind, pose, half = kind[keep], pose[keep], half[keep]
    return Solids(*map(torch.from_numpy, (kind, pose, half, np.full(len(kind), 0.5, np.float32), kind < 0, kind < 0)))


@pytest.mark.parametrize("max_candidates", [1 << 20, 100])
def test_cast_solids_equals_brute_force(max_candidates, monkeypatch):
    monkeypatch.setattr(raycast, "_MAX_CANDIDATES", max_candidates)
    solids = random_solids(np.random.default_rng(0), 80)
    azimuth = 0.003 + 2 * math.pi / 180 * torch.arange(180, dtype=torch.float64)
    elevation = torch.linspace(-0.5, 1.2, 24, dtype=torch.float64)
    T_solid_sensor = torch.linalg.inv(solids.pose)
    distance, solid = cast_solids(solids.kind, T_solid_sensor, solids.half_size, azimuth, elevation, 200.0)
    expected = brute_force(solids, np.zeros(3), ray_directions(azimuth, elevation).numpy())
    nearest = expected.min(0)
    # Rays that graze an edge, a few in 4,320, may hit or miss in float32.
    agree = np.isclose(distance.numpy(), nearest, rtol=0, atol=1e-3)  # inf is close to inf only
    assert agree.mean() > 0.999 and 0.2 < np.isfinite(nearest).mean() < 0.95
    hit = agree & np.isfinite(nearest)
    assert (solid.numpy()[hit] == expected.argmin(0)[hit]).mean() > 0.999
    assert (solid.numpy()[~np.isfinite(distance.numpy())] == -1).all()


@pytest.mark.parametrize(
    "name", ["aevascenes", *(pytest.param(name, marks=pytest.mark.slow) for name in ("av2_rolling", "waymo"))]
)
def test_rolling_shots_equal_brute_force(name):
    """Test every ray at its own time against every solid, with the poses of LiDAR and solids at that time."""
    street = SCENES["street"](np.random.default_rng([3, 0]))
    bodies = tuple(body for body in street.bodies if body.category or len(body.solids) < 5)[:90]
    scene = Scene(street.ground, street.ego, bodies)
    drive = Drive(scene, PROFILES[name], 0, 2, "small")
    seconds = float(drive._seconds[1])
    solids = drive._motion.solids(1)
    checked = wrong = wrong_solid = 0
    for number in (0, 1):
        unit = drive._profile.units[number]
        shots = drive._motion.shots(unit, seconds, 0.5, solids.origin)
        azimuth, up = shots.azimuth.numpy(), np.sort(np.radians(unit.elevations))
        chosen = np.linspace(0, len(azimuth) - 1, 8).astype(int)
        max_range = unit.max_range or drive._profile.max_range
        image, _ = cast_shots(shots, solids, scene.ground, max_range)
        distance, solid = (values.view(len(azimuth), -1).numpy() for values in (image.distance, image.solid))
        for column in chosen:
            now = float(shots.seconds[column])
            T = drive._motion.ego_poses(np.array([seconds if unit.is_virtual else now]))[0] @ unit.T_ego_sensor
            there = scene.solids(now, scene.body_poses(np.array([now]))[0])
            ray = np.stack([np.cos(azimuth[column]) * np.cos(up), np.sin(azimuth[column]) * np.cos(up), np.sin(up)])
            ranges = brute_force(there, T[:3, 3], T[:3, :3] @ ray)
            ground, _ = scene.ground.cast(torch.from_numpy(T[:3, 3].copy()), torch.from_numpy(T[:3, :3] @ ray))
            nearest = np.minimum(ranges.min(0), ground.numpy())
            who = np.where(ground.numpy() < ranges.min(0), -1, ranges.argmin(0))
            in_reach = nearest < max_range
            agree = np.isclose(distance[column], nearest, rtol=0, atol=2e-3)
            checked, wrong = checked + in_reach.sum(), wrong + (in_reach & ~agree).sum()
            wrong_solid += (in_reach & agree & (solid[column] != who)).sum()
    assert checked > 200 and wrong <= 0.002 * checked and wrong_solid <= 0.01 * checked


def test_ground_rays_end_on_the_first_surface_they_meet():
    ground = Ground(slope=(0.03, -0.02), curvature=7e-4)
    origin = torch.tensor([3.0, -2.0, 2.0], dtype=torch.float64)
    azimuth = torch.linspace(0, 6.2, 60, dtype=torch.float64)
    rays = ray_directions(azimuth, torch.tensor([-0.4, -0.2, -0.1, -0.06], dtype=torch.float64))
    t, cosine = ground.cast(origin, rays)
    x, y, z = (origin[:, None] + rays * t).numpy()
    # On the road, on the pavement, or on the kerb's face between them.
    above_road = z - ground.road_height(x, y)
    depth = ground.pavement_depth(torch.from_numpy(x), torch.from_numpy(y)).numpy()
    on_road, on_pavement = np.abs(above_road) < 1e-9, np.abs(above_road - ground.kerb) < 1e-9
    on_face = (np.abs(depth) < 0.01) & (above_road > -1e-9) & (above_road < ground.kerb + 1e-9)
    assert ((on_road & (depth <= 0)) | (on_pavement & (depth > 0)) | on_face).all()
    assert on_road.sum() > 20 and on_pavement.sum() > 20 and (on_face & ~on_road & ~on_pavement).sum() >= 3
    for part in np.linspace(0, 0.999, 200):  # the ray is above the ground before
        x, y, z = (origin[:, None] + rays * t * part).numpy()
        assert (z > ground.height(x, y) - 1e-9).all()
    assert ((cosine > 0) & (cosine <= 1)).all()
    assert ground.cast(origin, torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64))[0].isinf().all()


def test_a_wall_occludes_a_box_behind_it():
    pose = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    pose[:, :3, 3] = torch.tensor([[10.0, 0, 1], [20.0, 0, 1], [20.0, 30, 1]])
    half = torch.tensor([[0.1, 8, 3], [1, 1, 1], [1, 1, 1]], dtype=torch.float64)
    solids = Solids(torch.zeros(3, dtype=torch.int64), pose, half, torch.ones(3), *2 * [torch.zeros(3) > 0])
    ground, ego = Ground(slope=(0.0, 0.0), curvature=0.0, kerb=0.0), torch.eye(4, dtype=torch.float64)
    returns = scan(PROFILES["av2"], solids, ground, ego, torch.Generator().manual_seed(0))
    points, solid = returns.points.numpy(), returns.solid.numpy()
    assert (solid == 0).sum() > 1000 and (solid == 2).sum() > 20 and not (solid == 1).any()
    assert not ((points[:, 0] > 10.2) & (np.abs(points[:, 1]) < 0.7 * points[:, 0]) & (points[:, 2] < 1.0)).any()
    assert ((solid < 0) & (points[:, 0] > 5) & (points[:, 0] < 9) & (np.abs(points[:, 1]) < 5)).any()
    # Range noise: 1.5 cm on a plane that most rays hit at a right angle.
    front = points[(solid == 0) & (np.abs(points[:, 1]) < 2)]
    assert abs(front[:, 0].mean() - 9.9) < 2e-3 and 0.012 < front[:, 0].std() < 0.018


@pytest.mark.parametrize("name", ["demo", "nuscenes"])
def test_sweeps_depend_on_the_seed_only_not_on_the_order_of_calls(name):
    first, second = (make_drive(seed=7, num_sweeps=2, profile=name, scene="narrow") for _ in range(2))
    ahead = [first.sweep(i).points.tobytes() for i in (0, 1)]
    first.sweep(0).points[:] = 0  # a caller's changes do not reach the drive
    assert ahead == [second.sweep(i).points.tobytes() for i in (1, 0)][::-1]
    assert first.labels(0).flow.tobytes() == second.labels(0).flow.tobytes() and first.track_ids == second.track_ids
    assert make_drive(seed=8, num_sweeps=1, profile=name, scene="narrow").sweep(0).points.tobytes() != ahead[0]


def test_static_flow_is_ego_motion_and_the_ground_mask_is_exact(drive):
    for i in range(4):
        sweep, labels = drive.sweep(i), drive.labels(i)
        static, points = labels.category == 0, sweep.points.astype(float)
        T = np.linalg.inv(drive.poses[i + 1]) @ drive.poses[i]
        assert static.sum() > 40_000 and static[sweep.is_ground].all() and labels.is_valid[static].all()
        assert np.abs(transform_points(points, T) - points - labels.flow)[static].max() < 2e-6
    assert drive.labels(4) is None
    world = transform_points(points[sweep.is_ground], sweep.pose)
    off = np.abs(world[:, 2] - drive.scene.ground.height(world[:, 0].copy(), world[:, 1].copy()))
    depth = drive.scene.ground.pavement_depth(*torch.from_numpy(world[:, :2].copy()).T).numpy()
    at_kerb = np.abs(depth) < 0.1  # a few centimetres of range noise change the level there
    assert off[~at_kerb].max() < 0.05 and off.max() < drive.scene.ground.kerb + 0.05 and at_kerb.mean() < 0.1


def test_flow_moves_points_onto_the_same_object_in_the_next_sweep(drive):
    """Objects of boxes with enough returns: their points must land on them, and would not by ego motion alone."""
    body, points = zip(*((drive._body_of(drive.returns(i)), drive.sweep(i).points.astype(float)) for i in (1, 2)))
    static = transform_points(points[0], np.linalg.inv(drive.poses[2]) @ drive.poses[1])
    landed_at, checked, missed_without = points[0] + drive.labels(1).flow, [], 0
    for b, category in enumerate(each.category for each in drive.scene.bodies):
        rows, target = body[0] == b, body[1] == b
        if category in (None, "PEDESTRIAN", "BICYCLIST") or rows.sum() < 300 or target.sum() < 300:
            continue
        tree = cKDTree(points[1][target])
        landed = np.median(tree.query(landed_at[rows])[0])
        assert landed < 0.1, category
        checked.append(category)
        if np.linalg.norm((landed_at - static)[rows], axis=1).mean() > 0.4:
            missed_without += np.median(tree.query(static[rows])[0]) > landed
    assert set(checked) >= {"REGULAR_VEHICLE", "BUS", "TRUCK_CAB", "VEHICULAR_TRAILER"} and missed_without >= 2


def test_labels_of_bodies_that_leave_the_annotated_range_are_invalid():
    """Objects beyond the LiDAR's range are not annotated; here a car crosses that border between two sweeps."""
    drive = make_drive(seed=0, num_sweeps=2, profile="demo")
    body = drive._body_of(drive.returns(0))
    seen = next(b for b in np.unique(body[body < len(drive.scene.bodies)]) if drive._category[b])
    drive._is_annotated[1, seen] = False
    labels = drive.labels(0)
    assert not labels.is_valid[body == seen].any() and labels.is_valid[body != seen].all()
    assert (labels.category[body == seen] > 0).all()
    drive._is_annotated[0, seen] = False
    assert (drive.labels(0).category[body == seen] == 0).all()


def test_routes_are_continuous_trailers_cut_corners_and_braking_cars_stop():
    route = Route(1.0, 2.0, 0.3, start=-5, speed=4, radius=9, angle=-1.2)
    seconds = np.arange(0, 8, 0.01)
    path = route(seconds)
    assert np.allclose(np.hypot(*np.diff(path[:, :2], axis=0).T), 0.04, atol=1e-6)
    assert path[-1, 2] == pytest.approx(0.3 - 1.2) and np.abs(np.diff(path[:, 2])).max() < 0.005
    trailer = Towed(route, hitch=1.0, wheelbase=6.0, middle=3.0)(seconds)
    hitch = path[:, :2] - np.stack([np.cos(path[:, 2]), np.sin(path[:, 2])], -1)
    assert np.allclose(np.hypot(*(hitch - trailer[:, :2]).T), 3.0, atol=0.01)
    bend = np.abs(trailer[:, 2] - path[:, 2])
    assert bend.max() > 0.3 and bend[0] < 1e-6
    brakes = Route(0.0, 0.0, speed=4.0, acceleration=-2.0)
    assert np.allclose(brakes(np.arange(4.0))[:, 0], [0, 3, 4, 4]) and not brakes.is_static
    starts = Route(0.0, 0.0, speed=2.0, acceleration=1.0)
    assert np.allclose(starts(np.array([-3.0, -2.0, 0.0, 2.0]))[:, 0], [-2, -2, 0, 6])


@pytest.mark.parametrize(
    "wrong",
    [
        {"seed": -1},
        {"seed": 1.5},
        {"num_sweeps": 0},
        {"num_sweeps": 2.5},
        {"profile": "sonar"},
        {"scene": "moon"},
        {"weather": "hail"},
    ],
)
def test_wrong_arguments_are_refused(wrong, drive):
    with pytest.raises(CFlowError, match="choose one of|give whole numbers"):
        make_drive(**wrong)
    for call in (lambda: drive.sweep(-1), lambda: drive.sweep(5)):
        with pytest.raises(CFlowError, match="synthetic-av2-0003 has"):
            call()
