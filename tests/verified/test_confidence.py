"""Confidence: equal to the reference, the same however windows come, monotone, and it knows where the error is."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from oracle import confidence as oracle
from oracle import reference_flow
from scenes import assert_same, needs_gpu
from scenes import config as small_config
from scenes import scene as scene_of_boxes
from test_proof import model, scene, shuffled

from cflow_torch import CFlowError, CorrelationFlow, FlowResult, Sweep, Window, make_config, make_model
from cflow_torch.data.flow_file import CONTENTS, read_flow, write_flow
from cflow_torch.data.log import window as window_of
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import make_drive
from cflow_torch.verified import confidence

SCRIPT = Path(__file__).parents[2] / "scripts" / "calibrate_confidence.py"


@pytest.fixture
def numbered(monkeypatch):
    """The table with the number of each bin instead of its probability: no two bins are alike."""
    places = [i / 64 for i in range(len(confidence.TABLE["probabilities"]))]
    for module in (confidence, oracle):
        monkeypatch.setitem(module.TABLE, "probabilities", places)
    return places


def rows_of_table(probabilities):
    """Unlinked, still, then the four of what moves."""
    table, start, rows = confidence.TABLE, 1, []
    for bounds in ("crowd", "share", *4 * ("margin",)):
        rows.append(probabilities[start : start + 1 + len(table[bounds])])
        start += 1 + len(table[bounds])
    assert start == len(probabilities)
    return rows


def test_the_table_is_monotone_and_both_sides_read_it():
    assert oracle.TABLE == confidence.TABLE
    unlinked, *others = rows_of_table(confidence.TABLE["probabilities"])
    assert all(0 < p < 1 for p in confidence.TABLE["probabilities"])
    assert unlinked == sorted(unlinked, reverse=True) and unlinked[0] > unlinked[-1]
    for row in others:
        assert row == sorted(row) and row[0] < row[-1]


def test_every_bin_equals_the_reference(numbered):
    seen = set()
    for seed in range(16):
        settings = small_config(
            num_history=seed % 3,
            height_slices=seed % 2 * 4,
            use_timestamps=seed % 4 > 1,
            max_object=4.0,
            proof=True,
            clearance=0.3,
            children=True,
            relocate=seed % 2 > 0,
            yaw=seed % 3 > 0,
        )
        window = scene_of_boxes(500 + seed, num_history=seed % 3, poses=seed % 5 > 0, stamps=seed % 2 > 0)
        (result,) = CorrelationFlow(settings)([window])
        assert_same(result, reference_flow(window, settings))
        seen |= {round(64 * value) for value in result.confidence[result.is_valid].tolist()}
    kinds = [sum(bins[0] <= place < bins[1] for place in seen) for bins in ((1, 6), (6, 11), (11, 23), (23, 35))]
    assert min(kinds) >= 2, (kinds, seen)  # of every kind: not linked, still, moving in pairs, moving with history


def test_far_begins_where_the_table_says(numbered, monkeypatch):
    settings = model(num_history=0).config
    near = CorrelationFlow(settings)([scene(0)])[0]
    for module in (confidence, oracle):
        monkeypatch.setitem(module.TABLE, "far", 3)
    far = CorrelationFlow(settings)([scene(0)])[0]
    moves = near.residual_flow.any(1)
    distance = torch.from_numpy(np.linalg.norm(scene(0).pc0.points[:, :2], axis=1))
    change = (far.confidence - near.confidence) * 64
    assert (change[moves & (distance > 3.1)] == 6).all() and (change[~moves | (distance < 2.9)] == 0).all()
    assert (moves & (distance > 3.1)).any() and (moves & (distance < 2.9)).any()


def test_the_same_alone_in_a_batch_and_in_any_order(numbered):
    windows = [scene(0, 2), scene(1), scene(2, 1), scene(3, 2)]
    flow, rng = model(num_history=2), np.random.default_rng(0)
    for window, result in zip(windows, flow(windows)):
        assert torch.equal(flow([window])[0].confidence, result.confidence)
        pc0, order = shuffled(window.pc0, rng)
        mixed = Window(pc0, shuffled(window.pc1, rng)[0], tuple(shuffled(sweep, rng)[0] for sweep in window.pch))
        assert torch.equal(flow([mixed])[0].confidence, result.confidence[order])


@pytest.mark.cuda
@needs_gpu
def test_cuda_equals_cpu(numbered):
    windows = [scene(0, 2), scene(1), scene(2, 1), scene(3, 2)]
    settings = model(num_history=2).config
    on_cpu, on_gpu = (CorrelationFlow(settings, device=device)(windows) for device in ("cpu", "cuda"))
    for cpu, gpu in zip(on_cpu, on_gpu):
        assert_same(cpu, gpu)


def test_nothing_without_proof_and_zero_for_what_took_no_part():
    for settings in (make_config("paper"), make_config("paper", method="keypoints")):
        (result,) = make_model(settings, "cpu")([scene(0)])
        assert result.confidence is None and result.to("cpu").confidence is None
        assert "confidence" not in result.numpy()
    (result,) = model()([scene(0)])
    given = result.numpy()["confidence"]
    assert given.dtype == np.float32 and given.shape == (len(scene(0).pc0.points),)
    assert not given[~result.is_valid.numpy()].any() and (given[result.is_valid.numpy()] > 0).all()
    assert torch.equal(result.to("cpu").confidence, result.confidence)
    empty = Sweep(np.zeros((0, 3), np.float32))
    assert model()([Window(empty, empty)])[0].confidence.shape == (0,)


def test_a_wall_is_trusted_less_than_a_car():
    # Nothing but its ends tells how far a wall slid along itself; the car has two sides.
    rng = np.random.default_rng(0)
    length = rng.uniform(-3, 3, 600)
    wall = np.stack((length, np.full(600, 4.05), rng.uniform(-1, 1, 600)), 1)
    long_side = np.stack((rng.uniform(-2, 2, 300), np.full(300, -3.05), rng.uniform(-1, 1, 300)), 1)
    car = np.concatenate((long_side, np.stack((np.full(300, -2.05), rng.uniform(-5, -3, 300), long_side[:, 2]), 1)))
    shift = (0.3, 0.0, 0.0)
    points = np.concatenate((wall, car))
    (result,) = model(aperture=False)([Window(Sweep(points), Sweep(points + shift))])
    assert result.residual_flow[:, 0].min() > 0.2
    assert result.confidence[:600].max() < result.confidence[600:].min()


def test_dropping_what_is_least_trusted_lowers_the_error():
    drive = make_drive(seed=11, num_sweeps=8)
    window = window_of(drive, 6, 4)
    box = (-51.2, -51.2, -np.inf, 51.2, 51.2, np.inf)
    (result,) = model(num_history=4, height_slices=4, max_object=25.0, point_cloud_range=box)([window])
    points = np.asarray(window.pc0.points)[:, :3]
    labels = drive.labels(6)
    truth = labels.flow - ego_motion_flow(points, np.linalg.inv(window.pc1.pose) @ window.pc0.pose)
    rows = labels.is_valid & result.is_valid.numpy()
    error = np.linalg.norm(result.residual_flow.numpy() - truth, axis=1)[rows]
    told, moves = result.confidence.numpy()[rows], np.linalg.norm(truth, axis=1)[rows] >= 0.05
    for kind in (moves, ~moves):
        order = np.argsort(told[kind], kind="stable")
        assert error[kind][order][len(order) // 5 :].mean() < 0.8 * error[kind].mean()
    assert abs((error < 0.1).mean() - told.mean()) < 0.05


def test_a_file_has_it_on_request_only(tmp_path):
    (result,) = model()([scene(0)])
    write_flow(tmp_path / "plain.feather", result)
    assert read_flow(tmp_path / "plain.feather").confidence is None
    write_flow(tmp_path / "more.feather", result, (*CONTENTS, "confidence"))
    assert torch.equal(read_flow(tmp_path / "more.feather").confidence, result.confidence)
    without = FlowResult(**{name: value for name, value in vars(result).items() if name != "confidence"})
    with pytest.raises(CFlowError, match="proof=True"):
        write_flow(tmp_path / "none.feather", without, ("confidence",))


def calibration():
    spec = importlib.util.spec_from_file_location("calibrate_confidence", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pools_of_neighbours_that_fall():
    values, weights = np.array([0.2, 0.6, 0.4, 0.9, 0.8, 0.1]), np.array([1.0, 1.0, 3.0, 1.0, 1.0, 2.0])
    assert calibration().monotone(values, weights).tolist() == pytest.approx([0.2, 0.45, 0.45, 0.475, 0.475, 0.475])


def test_the_table_is_the_share_of_right_points_and_the_curves_follow(monkeypatch):
    script = calibration()
    sums = np.zeros((len(confidence.TABLE["probabilities"]), 6))
    sums[6:11, 0] = 1e6  # still, by how much is found again: points, right, dynamic, right, error, of dynamic
    sums[6:11, 1] = [5e5, 7e5, 6e5, 8e5, 9e5]
    sums[6, 2:] = [1e5, 0, 4e5, 3e5]
    table = script.fit(sums)
    assert table[6:11] == pytest.approx([0.5, 0.65, 0.65, 0.8, 0.9], abs=1e-4)
    monkeypatch.setitem(confidence.TABLE, "probabilities", table)
    assert script.reliability(sums)[1] == pytest.approx(0, abs=1e-4)
    assert script.sparsification(sums, True, (0.0, 0.5)) == pytest.approx([3.0, 3.0])
    # 4.9 million static points, 0.9 million of which share an error of 1e5 m and go first
    assert script.sparsification(sums, False, (0.0, 0.45 / 4.9, 0.5)) == pytest.approx([1 / 49, 0.5 / 44.5, 0.0])


def test_the_stored_table_is_what_the_script_would_write():
    file = Path(confidence.__file__).with_name("confidence.json")
    assert json.loads(file.read_text()) == confidence.TABLE
    assert all(round(p, 4) == p for p in confidence.TABLE["probabilities"])
