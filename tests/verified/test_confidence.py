"""Confidence: the oracle's bins, monotone, none where there is none, and it knows where the error is."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
from moving_scenes import from_images
from oracle import confidence as oracle
from scenes import flow_as_oracle
from test_changed_pixels import beside_a_wall
from turning_car import MODEL, turning_car

from cflow_torch import CFlowError, FlowResult, Sweep, VerifiedFlow, Window, make_config, make_model
from cflow_torch.data.log import CachedLog
from cflow_torch.data.log import window as window_of
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.ops.groups import Groups
from cflow_torch.simulator import make_drive
from cflow_torch.verified import confidence, motion_margin
from cflow_torch.verified.component_tree import Tree
from cflow_torch.verified.paired_test import verify
from cflow_torch.verified.refinement import refine
from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.verified.selection import Objects


def test_the_tables_are_monotone_and_the_oracle_reads_them():
    assert oracle.TABLE == confidence.TABLE
    table = confidence.TABLE
    sizes, shares, margins = (len(table[name]) + 1 for name in ("size", "share", "margin"))
    for name, falls in (("probabilities", False), ("moving", True)):
        assert table[name][confidence.Bins.unknown] == 0.5
        start = 2 + len(table["bias"])
        biased = table[name][2:start]
        assert biased == sorted(biased, reverse=not falls)
        rows = []
        for length in (*2 * (sizes,), *4 * (shares,), *4 * (1,), *8 * (margins,)):
            rows.append(table[name][start : start + length])
            start += length
        assert start == len(table[name]) and all(0 < p < 1 for p in table[name])
        unmatched, static, moving = rows[:2], rows[2:6], rows[10:]
        assert all(row == sorted(row, reverse=not falls) for row in unmatched)
        assert all(row == sorted(row, reverse=falls) for row in static)
        assert all(row == sorted(row) for row in moving)
    # A missed distant object is an unmatched component of many pixels, in pairs and with history.
    assert min(row[-1] for row in unmatched) > 0.5 > max(static[2])


def test_a_point_that_is_missing_in_another_sweep_has_bins_of_its_own(numbered):
    # A car of t appears from nowhere, and a wall stays.
    rng = np.random.default_rng(0)
    wall = np.stack((rng.uniform(-3, 3, 900), np.full(900, 4.05), rng.uniform(-1, 1, 900)), 1)
    car = np.stack((rng.uniform(-2, 2, 300), np.full(300, -3.05), rng.uniform(-1, 1, 300)), 1)
    both = Sweep(np.concatenate((wall, car)))
    shares = len(confidence.TABLE["share"]) + 1
    for older in ((), (Sweep(wall),)):
        result = flow_as_oracle(Window(both, Sweep(wall), older), MODEL.replace(num_history=1))
        bins = (result.confidence * 128).round().int()
        row = 2 * len(older)
        is_static = (bins >= confidence.Bins.static + row * shares) & (
            bins < confidence.Bins.static + (row + 1) * shares
        )
        assert is_static[:900].float().mean() > 0.9
        sizes = len(confidence.TABLE["size"]) + 1
        assert (
            bins[900:] == confidence.Bins.unmatched + len(older) * sizes + sizes - 2
        ).all()  # 40 pixels, the last bin but one


@pytest.mark.parametrize("num_more", [0, 1])
def test_in_a_pair_a_missed_person_is_biased_and_a_wall_is_not(numbered, num_more):
    # The person moves by half a pixel, which `refine` would find. Here nothing moves.
    rng = np.random.default_rng(0)
    walls = [np.stack((rng.uniform(-3, 3, 900), rng.normal(4.05, 0.03, 900), rng.uniform(-1, 1, 900)), 1) for _ in "ab"]
    person = rng.uniform((0, 0, -1), (0.3, 0.8, 0.8), (300, 3))
    model = VerifiedFlow(MODEL.replace(num_history=1))
    model.refine = lambda *args: refine(*args, slow=lambda sweeps, objects, flow, longest: 0 * flow)
    older, newer = (np.concatenate((person + (shift, 0, 0), wall)) for shift, wall in zip((0, 0.05), walls))
    window = Window(Sweep(older), Sweep(newer), num_more * (Sweep(older - (0.05, 0, 0)),))
    bins = (model([window])[0].confidence * 128).round()
    is_biased = (bins >= confidence.Bins.biased) & (bins < confidence.Bins.unmatched)
    assert is_biased[300:].float().mean() < 0.05
    assert is_biased[:300].float().mean() > 0.5 if num_more == 0 else not is_biased.any()


def test_a_wall_next_to_a_pedestrian_has_less_confidence(numbered):
    window, is_walker = beside_a_wall(0.13, 20.0)
    settings = MODEL.replace(point_cloud_range=(-10.0, -10.0, -3.0, 10.0, 10.0, 8.0), num_history=4)
    bins = (128 * flow_as_oracle(window, settings).confidence).round()
    is_beside = (bins >= confidence.Bins.beside) & (bins < confidence.Bins.moving)
    assert is_beside.any() and not is_beside[is_walker].all()
    assert np.abs(window.pc0.points[is_beside, 0] - 4.0).max() < 1.0


def test_far_begins_where_the_table_says(numbered, monkeypatch):
    window = turning_car(0)
    near = VerifiedFlow(MODEL)([window])[0]
    monkeypatch.setitem(confidence.TABLE, "far", 3)
    far = VerifiedFlow(MODEL)([window])[0]
    change = (far.confidence - near.confidence) * 128
    points = torch.from_numpy(window.pc0.points[:, :2])
    for number in near.cluster_id[near.residual_flow.any(1)].unique():
        is_own = near.cluster_id == number
        is_beyond = points[is_own].mean(0).norm() > 3
        assert (change[is_own] == 2 * confidence.Bins.num_margins * is_beyond).all()
    assert (change > 0).any() and (change[~near.residual_flow.any(1)] == 0).all()


def test_invalid_points_have_confidence_0_and_other_methods_none():
    window = turning_car(0)
    for preset in ("paper", "keypoints"):
        (result,) = make_model(make_config(preset), "cpu")([window])
        assert result.confidence is None and "confidence" not in result.numpy()
    (result,) = VerifiedFlow(MODEL)([window])
    assert result.confidence.dtype == torch.float32 and result.confidence.shape == (len(window.pc0.points),)
    assert not result.confidence[~result.is_valid].any() and (result.confidence[result.is_valid] > 0).all()


def test_a_wall_has_less_confidence_than_a_car(monkeypatch):
    # Only the ends of a wall show how far it slid along itself, but the car has two sides.
    rng = np.random.default_rng(0)
    wall = np.stack((rng.uniform(-3, 3, 600), np.full(600, 4.05), rng.uniform(-1, 1, 600)), 1)
    long_side = np.stack((rng.uniform(-2, 2, 300), np.full(300, -3.05), rng.uniform(-1, 1, 300)), 1)
    car = np.concatenate((long_side, np.stack((np.full(300, -2.05), rng.uniform(-5, -3, 300), long_side[:, 2]), 1)))
    points = np.concatenate((wall, car))
    model = VerifiedFlow(MODEL)
    monkeypatch.setattr(motion_margin, "_LEAST_LIKELY", 4 * (0.0,))  # both are dynamic
    model.verify = partial(verify, slides=lambda *given: torch.zeros(given[3].shape[:2], dtype=torch.bool))
    (result,) = model([Window(Sweep(points), Sweep(points + (0.3, 0.0, 0.0)))])
    assert result.residual_flow[:, 0].min() > 0.2
    assert result.confidence[:600].max() < result.confidence[600:].min()


@pytest.mark.parametrize("width", [1.0, 0.0])
def test_with_a_small_margin_an_object_that_left_its_position_moves_unless_it_is_a_line(width):
    # An object of 8 m moves by 5 m, so motions of 0.4 m more or less fit nearly as well.
    x, y = np.meshgrid(np.arange(-7.95, 0.0, 0.1), (3.05, 3.05 + width))
    points = np.stack((x.ravel(), y.ravel(), np.full(x.size, 0.1)), 1)
    result = flow_as_oracle(Window(Sweep(points), Sweep(points + (5.0, 0.0, 0.0))), MODEL.replace(max_speed=60.0))
    assert np.allclose(result.residual_flow[:, 0], 5.0 if width else 0.0, atol=0.2)


@pytest.mark.parametrize(("speed", "moves"), [(6.0, True), (0.7, False)])
def test_without_a_margin_only_fast_objects_move(speed, moves):
    # At t+1, the object is 1 m longer at the front and at the rear, so all displacements fit equally well.
    x, y = np.meshgrid(np.arange(-7.95, 0.0, 0.1), (3.05, 3.55, 4.05))
    longer, more = np.meshgrid(np.arange(-8.95, 1.0, 0.1), (3.05, 3.55, 4.05))
    points = np.stack((x.ravel(), y.ravel(), np.full(x.size, 0.1)), 1)
    newer = np.stack((longer.ravel() + speed, more.ravel(), np.full(longer.size, 0.1)), 1)
    result = flow_as_oracle(Window(Sweep(points), Sweep(newer)), MODEL.replace(max_speed=60.0))
    assert bool(result.residual_flow.any()) == moves


def test_a_motion_that_is_hardly_ever_right_is_dropped_and_its_probability_stays(monkeypatch):
    # In a pair, bushes far away of which t+1 has other points.
    rng = np.random.default_rng(0)
    places = rng.uniform((45, -20, 0), (60, 20, 0), (40, 1, 3))
    older, newer = (Sweep((places + rng.uniform(0, (0.5, 0.5, 1.5), (40, 12, 3))).reshape(-1, 3)) for _ in "ab")
    model = VerifiedFlow.from_preset()
    (result,) = model([Window(older, newer)])
    monkeypatch.setattr(motion_margin, "_LEAST_LIKELY", 4 * (0.0,))
    (every,) = model([Window(older, newer)])
    is_dropped = every.residual_flow.any(1) & ~result.residual_flow.any(1)
    assert is_dropped.any() and (every.moving[is_dropped] < 0.15).all() and torch.equal(result.moving, every.moving)


def test_a_remnant_has_the_margin_of_its_whole_node():
    """Forty lone pixels move by five columns. The remnant has two of them, at t, and others took the rest."""
    images = np.zeros((1, 2, 90, 12), dtype=np.uint8)
    images[0, 1, 2:82:2, 2] = images[0, 0, 2:82:2, 7] = 1
    sweeps, zero = from_images(images), torch.zeros(1, dtype=torch.int64)
    every = torch.arange(sweeps.num_pixels)
    tree = Tree(every, Groups(torch.zeros_like(every), 1), Groups(zero + 1, 1), zero, zero, torch.zeros(1, 2), 2)
    rigid = RigidMotion(
        torch.tensor([[5 * sweeps.grid.pixel_size, 0.0]]).double(), zero.double(), torch.zeros(1, 2).double()
    )
    is_remnant = (sweeps.pixels.step == 1) & (sweeps.pixels.row_col[0] < 6)
    bins = []
    for pixels in (every >= 0, is_remnant):
        by_object = Groups(torch.where(pixels, 0, 1), 1)
        objects = Objects(by_object, Groups(zero, 1), window=zero)
        bins.append(int(motion_margin.motion_margin(sweeps, tree, objects, rigid).bin))
    assert int(is_remnant.sum()) == 2 and bins[0] == bins[1]


def test_an_evident_motion_has_a_flow_however_slow_it_is():
    """The rear and one side of a car at 0.9 m/s, ahead of a LiDAR of 20 Hz."""
    body = torch.cartesian_prod(torch.arange(45.0), torch.arange(18.0), torch.arange(15.0))
    car = 0.1 * body[(body[:, 0] == 0) | (body[:, 1] == 17)] + 5.05
    wall = 0.1 * torch.cartesian_prod(torch.arange(80.0), torch.arange(2.0), torch.arange(15.0)) - 8.05
    newest, sweep_t, *older = (
        Sweep(torch.cat((car - torch.tensor([0.045 * k, 0.0, 0.0]), wall)), timestamp_ns=(9 - k) * 50_000_000)
        for k in range(6)
    )
    (result,) = make_model("default")([Window(sweep_t, newest, tuple(older))])
    assert (result.residual_flow[: len(car), 0] - 0.045).abs().max() < 0.002
    assert not result.residual_flow[len(car) :].any()


def test_a_bus_that_turns_moves():
    # 5 m from the centre, 5 degrees are 0.44 m: more than a pixel, and than the displacement of the margin.
    x = np.arange(-5.5, 5.5, 0.1)
    sides = np.concatenate([np.stack((x, np.full_like(x, y)), 1) for y in (-1.25, 1.25)])
    ends = np.array([(x, y) for x in (-5.5, 5.5) for y in np.arange(-1.2, 1.25, 0.1)])
    outline = np.concatenate((sides, ends))
    bus = np.concatenate([np.c_[outline, np.full(len(outline), z)] for z in (-0.9, -0.4, 0.1, 0.6)])
    angle = np.radians(5.0)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = np.c_[bus[:, :2] @ R.T + (0.7, 0.1), bus[:, 2]]
    result = flow_as_oracle(Window(Sweep(bus), Sweep(moved)), MODEL.replace(max_object_length=15.0))
    error = np.linalg.norm(result.residual_flow.numpy() - (moved - bus), axis=1)
    assert error.mean() < 0.1


def test_a_point_moves_if_its_flow_and_its_probability_say_so():
    flow = torch.tensor([[0.0, 0.0, 0.0], [0.04, 0.0, 0.0], [0.2, 0.0, 0.0], [0.2, 0.0, 0.0]])
    moving = torch.tensor([0.9, 0.9, 0.4, 0.6])
    assert FlowResult.of({"residual_flow": flow, "moving": moving}).is_moving.tolist() == [False, False, False, True]
    assert FlowResult.of({"residual_flow": flow}).is_moving.tolist() == [False, False, True, True]


def test_objects_leaves_out_what_is_probably_static():
    points = np.zeros((30, 3)) + np.arange(30)[:, None]
    flow = torch.zeros(30, 3)
    flow[:, 0] = 0.3
    given = {"residual_flow": flow, "flow": flow, "cluster_id": torch.arange(30) // 15}
    result = FlowResult.of({**given, "moving": torch.tensor([0.4, 0.8]).repeat_interleave(15)})
    assert result.objects(points)["id"].tolist() == [1] and result.objects(points, min_moving=0)["id"].tolist() == [
        0,
        1,
    ]
    assert len(FlowResult.of(given).objects(points)) == 2
    with pytest.raises(CFlowError, match="min_moving=50: give a probability"):
        result.objects(points, min_moving=50)


@pytest.mark.slow
def test_dropping_points_of_low_confidence_lowers_the_error():
    """We need four crossings, because a single drive may have hardly any errors."""
    of_drives = [_errors_of(make_drive(seed=seed, num_sweeps=8, scene="crossing")) for seed in range(11, 15)]
    error, told, moves = (np.concatenate(values) for values in zip(*of_drives))
    for kind in (moves, ~moves):
        order = np.argsort(told[kind], kind="stable")
        assert error[kind][order][len(order) // 5 :].mean() < 0.8 * error[kind].mean()
    assert abs((error < 0.1).mean() - told.mean()) < 0.05


def _errors_of(drive):
    """Return the error and the confidence of each labelled point of a window, and whether the point moves."""
    window = window_of(drive, 6, 4)
    (result,) = VerifiedFlow.from_preset()([window])
    labels = drive.labels(6)
    T_ego1_ego0 = np.linalg.inv(window.pc1.pose) @ window.pc0.pose
    truth = labels.flow - ego_motion_flow(np.asarray(window.pc0.points)[:, :3], T_ego1_ego0)
    rows = labels.is_valid & result.is_valid.numpy()
    error = np.linalg.norm(result.residual_flow.numpy() - truth, axis=1)
    return error[rows], result.confidence.numpy()[rows], np.linalg.norm(truth, axis=1)[rows] >= 0.05


@pytest.mark.slow
def test_what_moves_in_a_real_drive_is_told_from_bushes(kitti_file):
    """A table that fits simulated drives better may fit real ones worse. With rows of tall objects, the IoU is .89."""
    hdf5 = pytest.importorskip("cflow_torch.data.hdf5")
    file = kitti_file.with_name("kitti-0000-c2.h5")
    if not file.exists():
        pytest.skip(f"needs {file.name}")
    log = CachedLog(hdf5.HDF5Log(file), 7)
    model = VerifiedFlow.from_preset()
    both = either = 0
    for index in range(4, len(log.timestamps) - 1):
        window, labels = window_of(log, index, 4), log.labels(index)
        points = np.asarray(window.pc0.points)[:, :3]
        T_ego1_ego0 = np.linalg.inv(window.pc1.pose) @ window.pc0.pose
        moves = np.linalg.norm(labels.flow - ego_motion_flow(points, T_ego1_ego0), axis=1) >= 0.05
        is_scored = labels.is_valid & ~window.pc0.is_ground & (np.hypot(*points[:, :2].T) < 50)
        found = model([window])[0].is_moving.numpy()
        both += (moves & found & is_scored).sum()
        either += ((moves | found) & is_scored).sum()
    assert both / either > 0.94
