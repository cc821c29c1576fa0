"""Refinement of rigid motion: the reference's bits, whatever the order and the company; known motions are found."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from moving_scenes import LOWER, Scene, as_scene, moving_scene, one_window
from oracle import refinement as ref
from scenes import needs_gpu

from cflow_torch.verified.rigid import RigidMotion, rotate
from cflow_torch.verified.rigid_registration import _Groups, _Sums, refine
from cflow_torch.verified.voxel_centroids import UNITS, make_voxels


def refined(scene: Scene, **options) -> RigidMotion:
    return refine(
        scene.moving(), scene.pixel_of_place, len(scene.group), scene.grid, scene.batch.elapsed, scene.flow, **options
    )


def expected(scene: Scene, **options) -> RigidMotion:
    given = (scene.listed(), scene.listed_flow(), scene.batch.elapsed.tolist(), LOWER[:2], scene.grid.pixel_size)
    found = ref.refine(*given, **options)
    of = [torch.tensor(values, dtype=torch.float64) for values in zip(*found)]
    return RigidMotion(of[0].view(-1, 2), of[1], of[2].view(-1, 2))


def assert_same_bits(found: RigidMotion, wanted: RigidMotion) -> None:
    for field in dataclasses.fields(RigidMotion):
        a, b = getattr(found, field.name), getattr(wanted, field.name)
        assert a.shape == b.shape and a.dtype == b.dtype
        assert a.cpu().numpy().tobytes() == b.cpu().numpy().tobytes(), f"{field.name}: {a} is not {b}"


@pytest.mark.parametrize("num_steps", [2, 3, 5])
@pytest.mark.parametrize("snap", [0.0, 1 / 16, 0.05])
@pytest.mark.parametrize("pixel_size", [0.1, 0.2])
def test_bits_of_the_reference(pixel_size, snap, num_steps):
    moved = 0
    for seed in range(4):
        scene = moving_scene(seed, 1 + seed % 3, num_steps, pixel_size, snap)
        found = refined(scene)
        assert_same_bits(found, expected(scene))
        moved += int(((found.flow != scene.flow).any(1) & (found.turn != 0)).sum())
    assert moved > 0


def test_without_turns():
    scene = moving_scene(5, 2, 3)
    found = refined(scene, turns=False)
    assert_same_bits(found, expected(scene, turns=False))
    assert not found.turn.any() and (found.flow != scene.flow).any()


def test_order_of_points():
    scene = moving_scene(1, 2, 3, snap=0.05)
    order = torch.randperm(len(scene.place), generator=torch.Generator().manual_seed(0))
    batch = dataclasses.replace(
        scene.batch,
        positions=scene.batch.positions[:, order],
        takes_part=scene.batch.takes_part[order],
        image=scene.batch.image[order],
    )
    assert_same_bits(refined(scene._replace(batch=batch, place=scene.place[order])), refined(scene))


def test_batch_is_the_loop():
    scene = moving_scene(2, 4, 3, snap=1 / 16)
    together, seen = refined(scene), 0
    for window in range(4):
        alone, groups = one_window(scene, window)
        assert_same_bits(
            refined(alone), RigidMotion(together.flow[groups], together.turn[groups], together.centre[groups])
        )
        seen += len(groups)
    assert seen > 4


def test_no_groups_and_no_points():
    scene = moving_scene(0)
    none = scene._replace(group=torch.zeros_like(scene.group), flow=scene.flow[:0])
    assert refined(none).flow.shape == (0, 2)
    nowhere = scene._replace(group=torch.full_like(scene.group, len(scene.flow)))
    found = refined(nowhere)
    assert_same_bits(found, expected(nowhere))
    assert torch.equal(found.flow, scene.flow) and not found.turn.any()


def test_a_group_without_points_at_t_keeps_its_flow():
    for seed in range(30):
        scene = moving_scene(seed, 2, 3)
        points = scene.moving()
        missing = sorted(set(points.group.tolist()) - set(points.group[points.step == 1].tolist()))
        if missing:
            found = refined(scene)
            assert torch.equal(found.flow[missing], scene.flow[missing]) and not found.turn[missing].any()
            return
    raise AssertionError("no scene has such a group")


def scatter(angle: float, x: float, y: float) -> np.ndarray:
    """(N, 3) points 0.25 m apart in four slices of 2.5 m x 1.5 m, turned about the origin and moved."""
    xy = np.stack(np.meshgrid(np.arange(-1.25, 1.3, 0.25), np.arange(-0.75, 0.8, 0.25)), 2).reshape(-1, 2)
    cos, sin = math.cos(angle), math.sin(angle)
    turned = xy @ np.array([[cos, sin], [-sin, cos]]) + (x, y)
    return np.concatenate([np.concatenate([turned, np.full((len(turned), 1), z)], 1) for z in (0.2, 0.7, 1.2, 1.7)])


def test_a_known_motion_is_found():
    """A turning object whose points are told apart: what holds on to no turn leaves a tenth of it at most."""
    angle, clouds = 0.06, [scatter(0.06, 0.43, 0.13), scatter(0.0, 0.03, 0.03)]
    truth = torch.from_numpy(clouds[0] - clouds[1])[:, :2]
    scene = as_scene(clouds, [truth.mean(0).numpy()])
    found = refined(scene)
    assert_same_bits(found, expected(scene))
    assert abs(2 * math.atan(float(found.turn[0])) - angle) < 0.1 * angle
    old = torch.from_numpy(clouds[1])
    flow = torch.stack(found.flow_at(torch.zeros(len(old), dtype=torch.int64), old[:, 0], old[:, 1]), 1)
    assert (flow - truth).norm(dim=1).mean() < 0.1 * (scene.flow - truth).norm(dim=1).mean()


def test_step_is_the_least_squares_of_its_pairs():
    """The reference's normal equations against NumPy's least squares on the rows themselves."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        pairs = [
            ref.Pair(float(k), tuple(r), tuple(e), int(w))
            for k, r, e, w in zip(
                rng.integers(1, 3, 60),
                rng.integers(-4000, 4000, (60, 2)).tolist(),
                rng.integers(-80, 80, (60, 2)).tolist(),
                rng.integers(1, 257, 60),
            )
        ]
        given, way, turn = tuple(rng.normal(0, 300, 2)), tuple(rng.normal(0, 300, 2)), rng.normal(0, 0.02)
        rows, rhs = [], []
        for k, (r_x, r_y), (e_x, e_y), w in pairs:
            rows += [math.sqrt(w) * np.array([k, 0, -k * r_y]), math.sqrt(w) * np.array([0, k, k * r_x])]
            rhs += [math.sqrt(w) * e_x, math.sqrt(w) * e_y]
        held = 150 * 256 + 0.2 * sum(w * k * k for k, _, _, w in pairs)
        rows += [math.sqrt(held) * np.array(row) for row in ([1, 0, 0], [0, 1, 0])]
        rhs += [math.sqrt(held) * (given[0] - way[0]), math.sqrt(held) * (given[1] - way[1])]
        rows.append(np.array([0, 0, math.sqrt(20 * 256) * UNITS]))
        rhs.append(-math.sqrt(20 * 256) * UNITS * 2 * turn)
        wanted = np.linalg.lstsq(np.array(rows), np.array(rhs), rcond=None)[0]
        found = ref.gauss_newton(pairs, given, way, turn, True)
        assert np.abs(np.array(found) - wanted).max() < 1e-9 * max(1.0, np.abs(wanted).max())


@pytest.mark.parametrize("snap", [1 / 16, 0.1])
def test_nearest_takes_the_first_of_equals(snap):
    """Places on a lattice: several voxels are equally near, and places may lie outside of the image."""
    scene = moving_scene(3, 2, 2, snap=snap, num_points=400)
    voxels = make_voxels(scene.moving(), scene.pixel_of_place, len(scene.group), scene.grid, 2)
    listed = ref.centroids(scene.listed(), LOWER[:2], scene.grid.pixel_size)
    number = {(v.window, v.step, v.part, v.x, v.y): None for v in listed.values()}
    assert len(number) == voxels.group.numel() == len(listed)
    rng = np.random.default_rng(0)
    at = torch.from_numpy(rng.integers(0, voxels.group.numel(), 400))
    x, y = (
        values[at] + torch.from_numpy(rng.choice([-96, -51, -32, 0, 32, 51, 64, -4000], 400))
        for values in (voxels.x, voxels.y)
    )
    step = torch.from_numpy(rng.integers(0, 2, 400))
    found = voxels.nearest(voxels.window[at], step, voxels.part[at], x, y).tolist()
    ties = 0
    for i, (place, index) in enumerate(zip(at.tolist(), found)):
        window, part = int(voxels.window[place]), int(voxels.part[place])
        wanted = ref.nearest(listed, window, int(step[i]), part, int(x[i]), int(y[i]), scene.grid.pixel_size)
        if wanted is None:
            assert index == voxels.group.numel()
            continue
        same = [
            (int(values[index]))
            for values in (voxels.window, voxels.step, voxels.part, voxels.group, voxels.x, voxels.y)
        ]
        assert same == [wanted.window, wanted.step, wanted.part, wanted.group, wanted.x, wanted.y]
        least = (wanted.x - int(x[i])) ** 2 + (wanted.y - int(y[i])) ** 2
        others = [v for v in listed.values() if (v.window, v.step, v.part) == (window, int(step[i]), part)]
        ties += sum((v.x - int(x[i])) ** 2 + (v.y - int(y[i])) ** 2 == least for v in others) > 1
    assert ties > 5


def test_nearest_does_not_look_across_the_border():
    """A voxel in the first column is no neighbour of the last column of the row above."""
    cloud = np.array([[LOWER[0] + 0.02, 0.05, 0.2]])
    scene = as_scene([cloud, cloud], [np.zeros(2)])
    voxels = make_voxels(scene.moving(), scene.pixel_of_place, len(scene.group), scene.grid, 2)
    zero = torch.zeros(6, dtype=torch.int64)
    row = int((0.05 - LOWER[1]) / 0.1)
    y = torch.tensor([int((row + move + 0.5) * 0.1 * UNITS) for move in (-2, -1, 0, 1, 2, 0)])
    x = torch.full_like(y, int((scene.grid.width - 0.5) * 0.1 * UNITS))
    x[-1] = 20
    assert voxels.nearest(zero, zero, zero, x, y).tolist() == [2, 2, 2, 2, 2, 0]


@pytest.mark.parametrize("errors, is_limited", [(20, False), (4000, True)])
def test_step_is_that_of_the_reference_within_the_limits(errors, is_limited):
    rng, num = np.random.default_rng(1), 500
    groups = object.__new__(_Groups)
    groups.num, groups.turns, groups._weight = 1, True, torch.full((2049,), 256)
    groups.given = torch.tensor([[300.0], [-200.0]], dtype=torch.float64)
    way, turn = torch.tensor([[350.5], [-160.25]], dtype=torch.float64), torch.tensor([0.03], dtype=torch.float64)
    k, lever = rng.integers(1, 3, num), rng.integers(-3000, 3000, (num, 2))
    error = rng.integers(0, errors, (num, 2)) + lever[:, ::-1] * (-1, 1) * errors // 6000  # goes on and turns
    pairs = [ref.Pair(float(t), tuple(r), tuple(e), 256) for t, r, e in zip(k, lever.tolist(), error.tolist())]
    dx, dy, angle = ref.gauss_newton(pairs, (300.0, -200.0), (350.5, -160.25), 0.03, True)
    wanted = [ref.limit(350.5 + dx, 300.0), ref.limit(-160.25 + dy, -200.0)]
    wanted_turn = min(max(0.03 + angle / 2, -ref.LARGEST_TURN), ref.LARGEST_TURN)
    assert (
        (wanted_turn in (-0.1, 0.1)) == is_limited == (wanted[0] == 300 + 0.15 * UNITS) == (wanted[1] != -160.25 + dy)
    )

    columns = (torch.from_numpy(np.ascontiguousarray(v)) for v in (16 * k, *lever.T, *error.T))
    sums = _Sums(*groups._normal_equations(torch.zeros(num, dtype=torch.int64), *columns)[1:])
    found, found_turn = groups.step(way, turn, sums)
    assert found.flatten().tolist() == wanted and found_turn.tolist() == [wanted_turn]


def test_long_levers_do_not_overflow():
    """A group that spans the whole of a wide region: the sums of squared levers exceed 62 bits, and stay exact."""
    num = 1 << 16
    group = torch.zeros(num, dtype=torch.int64)
    groups = object.__new__(_Groups)
    groups.num, groups._weight = 1, torch.full((2049,), 256)
    lever = torch.full((num,), 150 * UNITS)
    zero = torch.zeros_like(lever)
    sums = _Sums(*groups._normal_equations(group, torch.full_like(lever, 32), lever, lever, zero, zero)[1:])
    exact = num * 256 * 32 * 32 * 2 * (150 * UNITS) ** 2
    assert exact > 2**62 and int(sums.high) * 2**20 + int(sums.low) == exact


def test_rotate_is_the_rotation():
    x, y = rotate(torch.tensor([math.tan(0.15)]), torch.tensor([2.0]), torch.tensor([1.0]))
    assert abs(float(x) - (2 * math.cos(0.3) - math.sin(0.3))) < 1e-6
    assert abs(float(y) - (2 * math.sin(0.3) + math.cos(0.3))) < 1e-6


@needs_gpu
def test_same_bits_on_the_gpu():
    scene = moving_scene(4, 3, 4, snap=0.05)
    points = scene.moving()
    there = dataclasses.replace(points, **{f.name: getattr(points, f.name).cuda() for f in dataclasses.fields(points)})
    found = refine(
        there, scene.pixel_of_place.cuda(), len(scene.group), scene.grid, scene.batch.elapsed.cuda(), scene.flow.cuda()
    )
    assert_same_bits(found, refined(scene))
