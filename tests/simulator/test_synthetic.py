"""The synthetic drive: geometry against brute force, truth against the next sweep, seeds, poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.drive import AXLE_HEIGHT
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.lidar import scan
from cflow_torch.simulator.objects import Body, Route, Towed
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.raycast import BOX, CYLINDER, ELLIPSOID, Solids, cast_solids, ray_directions
from cflow_torch.simulator.street import build_street
from cflow_torch.types import CFlowError


@pytest.fixture(scope="module")
def drive():
    return make_drive(seed=3, num_sweeps=5, profile="av2")


def transform(T, points):
    return points @ T[:3, :3].T + T[:3, 3]


def brute_force(solids, origin, directions):
    """Ranges (P, R) of one ray after another, float64, straight from the definitions of the unit solids."""
    ranges = np.full((len(solids.kind), directions.shape[1]), np.inf)
    for p, (kind, pose, half) in enumerate(zip(solids.kind, solids.pose.numpy(), solids.half_size.numpy())):
        to_unit = np.linalg.inv(pose)
        o = (to_unit[:3, :3] @ origin + to_unit[:3, 3]) / half
        d = (to_unit[:3, :3] @ directions) / half[:, None]
        low, high = np.full(d.shape[1], -np.inf), np.full(d.shape[1], np.inf)
        axes = {BOX: (0, 1, 2), CYLINDER: (2,), ELLIPSOID: ()}[int(kind)]
        for k in axes:
            ends = np.sort(np.stack([(-1 - o[k]) / d[k], (1 - o[k]) / d[k]]), axis=0)
            low, high = np.maximum(low, ends[0]), np.minimum(high, ends[1])
        round_axes = {BOX: 0, CYLINDER: 2, ELLIPSOID: 3}[int(kind)]
        if round_axes:
            o, d = o[:round_axes], d[:round_axes]
            a, b, c = (d * d).sum(0), (o[:, None] * d).sum(0), (o * o).sum() - 1
            with np.errstate(invalid="ignore"):
                root = np.sqrt(b * b - a * c)
            low, high = np.fmax(low, (-b - root) / a), np.fmin(high, (-b + root) / a)
            high[np.isnan(root)] = -np.inf
        hit = (low <= high) & (low > 0)
        ranges[p, hit] = low[hit]
    return ranges


def random_solids(rng, number, spread=30.0):
    """Solids of all kinds, turned any way, none around the origin; one long wall, one beam overhead."""
    pose = np.tile(np.eye(4), (number, 1, 1))
    pose[:, :3, :3] = np.linalg.qr(rng.normal(size=(number, 3, 3)))[0]
    pose[:, :3, :3] *= np.linalg.det(pose[:, :3, :3])[:, None, None]
    pose[:, :3, 3] = rng.uniform(-spread, spread, (number, 3)) * (1, 1, 0.2)
    half = rng.uniform(0.05, 1.5, (number, 3))
    pose[0, :3, :3], pose[0, :3, 3], half[0] = np.eye(3), (0, 4, 0), (40, 0.1, 2)
    pose[1, :3, :3], pose[1, :3, 3], half[1] = np.eye(3), (0, 0, 3), (5, 5, 0.1)
    keep = np.linalg.norm(pose[:, :3, 3], axis=1) > 2.9
    kind = rng.integers(0, 3, number)
    kind[:2] = BOX
    kind, pose, half = kind[keep], pose[keep], half[keep]
    return Solids(*map(torch.from_numpy, (kind, pose, half, np.full(len(kind), 0.5, np.float32), kind < 0)))


@pytest.mark.parametrize("max_candidates", [1 << 20, 100])
def test_cast_solids_equals_brute_force(max_candidates):
    solids = random_solids(np.random.default_rng(0), 150)
    azimuth = 0.003 + 2 * math.pi / 180 * torch.arange(180, dtype=torch.float64)
    elevation = torch.linspace(-0.5, 1.2, 24, dtype=torch.float64)
    distance, solid = cast_solids(
        solids.kind, torch.linalg.inv(solids.pose), solids.half_size, azimuth, elevation, 200.0, max_candidates
    )
    expected = brute_force(solids, np.zeros(3), ray_directions(azimuth, elevation).numpy())
    nearest = expected.min(0)
    # A ray that grazes an edge may be decided either way in float32; there are a few in 4,320.
    agree = np.isclose(distance.numpy(), nearest, rtol=0, atol=1e-3)  # inf is close to inf only
    assert agree.mean() > 0.999
    assert 0.2 < np.isfinite(nearest).mean() < 0.95
    hit = agree & np.isfinite(nearest)
    assert (solid.numpy()[hit] == expected.argmin(0)[hit]).mean() > 0.999
    assert (solid.numpy()[~np.isfinite(distance.numpy())] == -1).all()


def test_cast_solids_of_an_empty_scene_hits_nothing():
    empty = torch.zeros(0, dtype=torch.int64), torch.zeros(0, 4, 4).double(), torch.zeros(0, 3).double()
    azimuth, elevation = torch.arange(8).double() * math.pi / 4, torch.zeros(2).double()
    distance, solid = cast_solids(*empty, azimuth, elevation, 100.0)
    assert distance.isinf().all() and (solid == -1).all() and len(solid) == 16


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
    # Nothing was passed on the way.
    for part in np.linspace(0, 0.999, 200):
        x, y, z = (origin[:, None] + rays * t * part).numpy()
        assert (z > ground.height(x, y) - 1e-9).all()
    assert ((cosine > 0) & (cosine <= 1)).all()
    assert ground.cast(origin, torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64))[0].isinf().all()


def test_nothing_is_seen_behind_a_wall():
    """A wall at x = 10 hides the boxes behind it; a box beside it is seen."""
    pose = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    pose[:, :3, 3] = torch.tensor([[10.0, 0, 1], [20.0, 0, 1], [20.0, 30, 1]])
    half = torch.tensor([[0.1, 8, 3], [1, 1, 1], [1, 1, 1]], dtype=torch.float64)
    plain = torch.ones(3)
    solids = Solids(torch.zeros(3, dtype=torch.int64), pose, half, plain, plain < 0)
    ground, ego = Ground(slope=(0.0, 0.0), curvature=0.0, kerb=0.0), torch.eye(4, dtype=torch.float64)
    returns = scan(PROFILES["av2"], solids, ground, ego, torch.Generator().manual_seed(0), 10**8)
    points, solid = returns.points.numpy(), returns.solid.numpy()
    assert (solid == 0).sum() > 1000 and (solid == 2).sum() > 20 and not (solid == 1).any()
    shadow = (points[:, 0] > 10.2) & (np.abs(points[:, 1]) < 0.7 * points[:, 0]) & (points[:, 2] < 1.0)
    assert not shadow.any()
    lit = (solid < 0) & (points[:, 0] > 5) & (points[:, 0] < 9) & (np.abs(points[:, 1]) < 5)
    assert lit.any()
    # Range noise: 1.5 cm on a plane that most rays meet nearly head on.
    front = points[(solid == 0) & (np.abs(points[:, 1]) < 2)]
    assert abs(front[:, 0].mean() - 9.9) < 2e-3 and 0.012 < front[:, 0].std() < 0.018


def test_same_seed_same_bytes_in_any_order():
    first, second = (make_drive(seed=7, num_sweeps=3, profile="demo") for _ in range(2))
    ahead = [first.sweep(i).points.tobytes() for i in (0, 1, 2)]
    back = [second.sweep(i).points.tobytes() for i in (2, 1, 0)]
    assert ahead == back[::-1]
    assert first.labels(1).flow.tobytes() == second.labels(1).flow.tobytes()
    assert first.track_ids == second.track_ids
    other = make_drive(seed=8, num_sweeps=3, profile="demo")
    assert other.sweep(0).points.tobytes() != ahead[0] and other.track_ids != first.track_ids


def test_a_callers_changes_do_not_reach_the_log():
    log = make_drive(seed=7, num_sweeps=1, profile="demo")
    before = log.sweep(0).points.copy()
    log.sweep(0).points[:] = 0
    log.sweep(0).pose[:] = 0
    assert np.array_equal(log.sweep(0).points, before) and log.sweep(0).pose[3, 3] == 1


def test_shapes_and_types(drive):
    sweep, labels = drive.sweep(1), drive.labels(1)
    number = len(sweep.points)
    assert 60_000 < number < 115_200
    assert sweep.points.dtype == np.float32 and sweep.points.shape == (number, 3) and np.isfinite(sweep.points).all()
    assert sweep.is_ground.dtype == bool and 0.05 < sweep.is_ground.mean() < 0.5
    assert sweep.pose.dtype == np.float64 and sweep.timestamp_ns == drive.timestamps[1]
    assert np.diff(drive.timestamps).tolist() == [100_000_000] * 4
    assert labels.flow.shape == (number, 3) and labels.flow.dtype == np.float32
    assert labels.category.dtype == np.uint8 and labels.is_valid.dtype == bool
    assert drive.labels(4) is None
    channels = drive.channels(1)
    assert np.array_equal(np.unique(channels.laser_number), np.arange(64))
    assert channels.offset_ns.min() >= 0 and channels.offset_ns.max() < 100_000_000
    assert len(window(drive, 3, num_history=2).pch) == 2


def test_poses_form_a_smooth_drive_with_a_turn(drive):
    R = drive.poses[:, :3, :3]
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3), atol=1e-12) and np.allclose(np.linalg.det(R), 1)
    steps = np.linalg.norm(np.diff(drive.poses[:, :3, 3], axis=0), axis=1)
    assert np.allclose(steps, drive.scene.ego.speed * 0.1, rtol=0.01)
    yaw = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    assert math.degrees(yaw[-1] - yaw[-2]) > 1.0


def test_ground_is_level_with_the_wheels_and_exact(drive):
    sweep = drive.sweep(2)
    near = sweep.is_ground & (np.hypot(*sweep.points[:, :2].T) < 7)
    assert near.sum() > 100 and abs(np.median(sweep.points[near, 2]) + AXLE_HEIGHT) < 0.05
    world = transform(sweep.pose, sweep.points[sweep.is_ground].astype(float))
    height = drive.scene.ground.height(world[:, 0].copy(), world[:, 1].copy())
    off = np.abs(world[:, 2] - height)
    depth = drive.scene.ground.pavement_depth(*torch.from_numpy(world[:, :2].copy()).T).numpy()
    at_kerb = np.abs(depth) < 0.1  # a few centimetres of range noise change the level there
    assert off[~at_kerb].max() < 0.05 and off.max() < drive.scene.ground.kerb + 0.05
    assert at_kerb.mean() < 0.1


def test_static_flow_is_ego_motion(drive):
    for i in range(4):
        sweep, labels = drive.sweep(i), drive.labels(i)
        static = labels.category == 0
        T = np.linalg.inv(drive.poses[i + 1]) @ drive.poses[i]
        points = sweep.points[static].astype(float)
        assert static.sum() > 40_000 and static[sweep.is_ground].all()
        assert np.abs(transform(T, points) - points - labels.flow[static]).max() < 2e-6
        assert labels.is_valid[static].all()


def test_static_world_stays_where_it_is(drive):
    clouds = []
    for i in (0, 3):
        points, keep = drive.sweep(i).points, drive.labels(i).category == 0
        keep &= ~drive.sweep(i).is_ground & (np.linalg.norm(points, axis=1) < 15)
        clouds.append(transform(drive.poses[i], points[keep].astype(float)))
    distance, _ = cKDTree(clouds[1]).query(clouds[0])
    assert len(distance) > 5000 and np.median(distance) < 0.05


def test_flow_moves_points_onto_the_same_object_in_the_next_sweep(drive):
    """Boxy objects with enough returns; movers must land, and would not without their own motion."""
    body = [drive._body_of(drive.returns(i)) for i in (1, 2)]
    points = [drive.sweep(i).points.astype(float) for i in (1, 2)]
    labels = drive.labels(1)
    static = transform(np.linalg.inv(drive.poses[2]) @ drive.poses[1], points[0])
    checked, missed_without = {}, 0
    for b, thing in enumerate(drive.scene.bodies):
        rows, target = body[0] == b, body[1] == b
        if thing.category in (None, "PEDESTRIAN", "BICYCLIST") or rows.sum() < 300 or target.sum() < 300:
            continue
        tree = cKDTree(points[1][target])
        landed = np.median(tree.query(points[0][rows] + labels.flow[rows])[0])
        assert landed < 0.1, thing.category
        checked[thing.category] = checked.get(thing.category, 0) + 1
        speed = np.linalg.norm((points[0] + labels.flow - static)[rows], axis=1).mean()
        if speed > 0.4:
            missed_without += np.median(tree.query(static[rows])[0]) > landed
    assert set(checked) >= {"REGULAR_VEHICLE", "BUS", "TRUCK_CAB", "VEHICULAR_TRAILER"} and sum(checked.values()) >= 8
    assert missed_without >= 2


def test_traffic_has_the_promised_variety():
    drive = make_drive(seed=0, num_sweeps=2, profile="av2")
    sweep, labels = drive.sweep(0), drive.labels(0)
    T = np.linalg.inv(drive.poses[1]) @ drive.poses[0]
    residual = labels.flow - (transform(T, sweep.points.astype(float)) - sweep.points)
    speed, distance = 10 * np.linalg.norm(residual, axis=1), np.linalg.norm(sweep.points[:, :2], axis=1)
    assert set(np.unique(labels.category)) == {0, 4, 7, 17, 19, 26, 27}
    assert 15 < speed.max() < 21
    assert ((speed > 3) & (distance > 40) & (distance < 60)).sum() > 50
    parked = (labels.category == 19) & (speed < 1e-3)
    assert parked.sum() > 1000
    ways = np.stack([body.way(np.array([0.0, 0.1])) for body in drive.scene.bodies])
    turning = [b.category for b, way in zip(drive.scene.bodies, ways) if abs(way[1, 2] - way[0, 2]) > 0.02]
    assert "REGULAR_VEHICLE" in turning and "TRUCK_CAB" in turning


def test_legs_swing_but_their_truth_is_the_track(drive):
    walker = next(i for i, b in enumerate(drive.scene.bodies) if b.category == "PEDESTRIAN" and b.way.speed > 1)
    solids = np.flatnonzero(drive.scene.table.body == walker)
    poses = [
        drive.scene.solids(0.1 * i, drive._body_poses[i]).pose.numpy()[solids] for i in (0, 1)
    ]  # trunk, head, leg, leg
    relative = [np.linalg.inv(drive._body_poses[i, walker]) @ poses[i] for i in (0, 1)]
    moved = np.abs(relative[1] - relative[0]).reshape(len(solids), -1).max(1)
    assert (moved[:2] < 1e-12).all() and (moved[2:] > 0.01).all()


def test_boxes_hold_their_points(drive):
    boxes, points, labels = drive.boxes(1), drive.sweep(1).points.astype(float), drive.labels(1)
    inside_any = np.zeros(len(points), bool)
    for pose, size, number in zip(boxes.pose, boxes.size, boxes.num_points):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        inside = (np.abs(local) < size / 2).all(1)
        assert inside.sum() >= 0.98 * number
        inside_any |= inside
    assert inside_any[labels.category > 0].mean() > 0.995
    assert boxes.num_points.sum() == (labels.category > 0).sum()


def test_labels_of_bodies_that_leave_the_annotated_range_are_invalid():
    """Nobody annotates beyond the LiDAR's reach: here a car crosses that border between two sweeps."""
    drive = make_drive(seed=0, num_sweeps=2, profile="demo")
    body = drive._body_of(drive.returns(0))
    seen = next(b for b in np.unique(body[body < len(drive.scene.bodies)]) if drive._category[b])
    drive._is_annotated[1, seen] = False
    labels = drive.labels(0)
    assert not labels.is_valid[body == seen].any() and labels.is_valid[body != seen].all()
    assert (labels.category[body == seen] > 0).all()
    drive._is_annotated[0, seen] = False
    assert (drive.labels(0).category[body == seen] == 0).all()


def test_traffic_does_not_collide_in_the_first_second():
    """Footprints of annotated bodies, by separating axes; the truck's cab and trailer share the hitch."""
    seconds = np.array([0.0, 0.5, 1.0])
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    for seed in range(12):
        scene = build_street(np.random.default_rng(seed))
        bodies = [b for b in scene.bodies if b.category]
        ego = Body([], scene.ego, "REGULAR_VEHICLE", (4.8, 1.9, 1.6))
        for second in seconds:
            ways = np.stack([b.way(np.array([second]))[0] for b in (*bodies, ego)])
            ways[-1, :2] += 1.4 * np.array([np.cos(ways[-1, 2]), np.sin(ways[-1, 2])])  # rear axle to middle
            axes = np.stack([[np.cos(ways[:, 2]), np.sin(ways[:, 2])], [-np.sin(ways[:, 2]), np.cos(ways[:, 2])]])
            axes = axes.transpose(2, 0, 1)  # (M, which, xy)
            sizes = np.array([b.size[:2] for b in (*bodies, ego)])
            corners = ways[:, None, :2] + np.einsum("ck,mk,mkx->mcx", signs, sizes, axes)
            spans = np.einsum("mcx,nkx->mnkc", corners, axes)  # corners of m along the axes of n
            own = np.einsum("mcx,mkx->mkc", corners, axes)
            apart = (spans.max(-1) < own.min(-1)[None]) | (spans.min(-1) > own.max(-1)[None])
            apart = apart.any(-1)
            collides = np.argwhere(~(apart | apart.T))
            pairs = {
                tuple(sorted(((*bodies, ego)[i].category, (*bodies, ego)[j].category))) for i, j in collides if i < j
            }
            assert pairs <= {("TRUCK_CAB", "VEHICULAR_TRAILER"), ("PEDESTRIAN", "PEDESTRIAN")}, (seed, second)


def test_route_is_continuous_and_a_trailer_cuts_the_corner():
    route = Route(1.0, 2.0, 0.3, start=-5, speed=4, radius=9, angle=-1.2)
    seconds = np.arange(0, 8, 0.01)
    way = route(seconds)
    assert np.allclose(np.hypot(*np.diff(way[:, :2], axis=0).T), 0.04, atol=1e-6)
    assert way[-1, 2] == pytest.approx(0.3 - 1.2) and np.abs(np.diff(way[:, 2])).max() < 0.005
    towed = Towed(route, hitch=1.0, wheelbase=6.0, middle=3.0)
    trailer = towed(seconds)
    hitch = way[:, :2] - np.stack([np.cos(way[:, 2]), np.sin(way[:, 2])], -1)
    assert np.allclose(np.hypot(*(hitch - trailer[:, :2]).T), 3.0, atol=0.01)
    bend = np.abs(trailer[:, 2] - way[:, 2])
    assert bend.max() > 0.3 and bend[0] < 1e-6
    assert np.allclose(towed(seconds[300:301]), trailer[300:301], atol=2e-3)


@pytest.mark.parametrize("wrong", [{"seed": -1}, {"num_sweeps": 0}, {"profile": "sonar"}])
def test_wrong_arguments_are_refused(wrong):
    with pytest.raises(CFlowError):
        make_drive(**wrong)


def test_a_missing_sweep_is_refused(drive):
    for index in (-1, 5):
        with pytest.raises(CFlowError, match="sweeps 0 ... 4"):
            drive.sweep(index)
