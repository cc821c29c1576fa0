"""The dense method equals the oracle on random scenes and real drives, and finds known motions."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch
from oracle import reference_flow
from scenes import assert_same, assert_same_bits, box, config, flow_as_oracle, needs_kornia_labelling, pose, scene

from cflow_torch import CFlowError, CorrelationFlow, FlowResult, Sweep, Window, estimate_flow, make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window as window_of
from cflow_torch.simulator import make_drive

ENGINES = [{"correlation": "conv"}, pytest.param({"labeling": "kornia"}, marks=needs_kornia_labelling)]


@pytest.mark.parametrize("seed", [*range(12), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(12, 20))])
def test_equals_the_oracle_on_random_scenes(seed):
    settings = config(
        num_history=seed % 5,
        pixel_sizes=((0.25,), (0.5, 0.25), (0.8, 0.4, 0.2), (0.11,))[seed % 4],
        sectional_view=seed % 2 == 0,
        connectivity=(4, 8)[seed % 3 > 0],
        max_speed=(None, 6.0)[seed % 5 > 2],
        max_extent=(5.0, 0.3, 1000.0)[seed % 7 % 3],
        ego_box=(None, (-3.0, -2.0, 2.5, 3.0))[seed % 6 == 5],
    )
    flow_as_oracle(scene(seed, num_history=seed % 5, poses=seed % 3 > 0, stamps=seed % 4 > 1), settings)


@pytest.mark.parametrize("engines", ENGINES)
def test_engines_equal_the_oracle(engines):
    for seed, sectional_view in ((1, True), (2, False)):
        settings = config(num_history=2, pixel_sizes=(0.5, 0.25), sectional_view=sectional_view, **engines)
        flow_as_oracle(scene(seed, num_history=2), settings)


def test_the_real_pair_equals_the_oracle(av2_folder):
    near = (-20.0, -15.0, -math.inf, 15.0, 15.0, math.inf)  # the whole is slow for the oracle
    result = flow_as_oracle(window_of(AV2Log(av2_folder), 0), make_config("paper", point_cloud_range=near))
    assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 1000  # there is something to find


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {"num_history": 8, "pixel_sizes": (0.8, 0.4, 0.3, 0.2, 0.1)},
        {"num_history": 2, "pixel_sizes": (0.4, 0.1), "sectional_view": True},
        {"num_history": 8, "connectivity": 4, "max_speed": 30.0, "max_extent": 8.0},
    ],
    ids=["h8-5scales", "h2-sectional", "h8-connectivity4"],
)
def test_drives_equal_the_oracle(kitti_file, data_root, settings):
    with HDF5Log(kitti_file) as kitti, HDF5Log(data_root / "av2-crown" / "av2-crown.h5") as crown:
        history = settings["num_history"]
        logs = [(kitti, 9), (crown, len(crown) - 2), (make_drive(seed=11, num_sweeps=11), 9)]
        for window in [window_of(log, index, min(history, index)) for log, index in logs]:
            result = flow_as_oracle(window, make_config("paper", **settings))
            assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 500


WIDE = (-8, -8, -1, 8, 8, 3)
PAPER = {"preset": "paper", "pixel_size": 0.25, "point_cloud_range": WIDE}


def street(seed: int) -> list:
    """Three boxes that do not touch."""
    rng, positions = np.random.default_rng(seed), [(-5.0, -4.0, 0.0), (0.5, 2.5, 0.0), (4.0, -3.0, 0.0)]
    return [box(rng, 2.5, 1.5, 1.5, 400) + position for position in positions]


def test_every_object_gets_its_own_motion():
    pc0 = np.concatenate(street(0))
    truth = np.repeat(np.array([[0.5, -0.25, 0], [0, 0, 0], [-0.5, 0.75, 0]]), 400, axis=0)
    result = estimate_flow(pc0, pc0 + truth, **PAPER)
    assert np.array_equal(result.residual_flow.numpy(), truth)
    assert result.score.tolist() == [1.0] * 1200
    assert result.cluster_id.tolist() == [0] * 400 + [2] * 400 + [1] * 400  # raster order: rows of y first


def test_a_static_world_does_not_move_when_the_sensor_does():
    pc_world = np.concatenate(street(1))
    T_ego1_ego0 = np.linalg.inv(pose(0.9, 0.1, 0.05))
    pc1 = pc_world @ T_ego1_ego0[:3, :3].T + T_ego1_ego0[:3, 3]
    result = estimate_flow(pc_world, pc1, T_ego1_ego0=T_ego1_ego0, **PAPER)
    assert np.abs(result.pose_flow.numpy() - (pc1 - pc_world)).max() < 1e-6
    assert not result.residual_flow.any() and torch.equal(result.flow, result.pose_flow)
    without = estimate_flow(pc_world, pc1, **PAPER)
    assert not without.pose_flow.any() and without.residual_flow.any()  # else the test would see nothing
    start = pose(3.0, 1.0, 1.5)
    posed = Window(Sweep(pc_world, pose=start), Sweep(pc1, pose=start @ pose(0.9, 0.1, 0.05)))
    settings = {name: value for name, value in PAPER.items() if name != "preset"}
    assert_same(CorrelationFlow(make_config("paper", **settings))([posed])[0], result)


def test_flow_has_the_axes_of_t1():
    """The vehicle rotates to the left by 90 degrees: a car that drives ahead at t drives to the right at t+1."""
    T_ego1_ego0, car = np.linalg.inv(pose(0.0, 0.0, math.pi / 2)), street(2)[1]
    result = estimate_flow(car, (car + [0.5, 0, 0]) @ T_ego1_ego0[:3, :3].T, T_ego1_ego0=T_ego1_ego0, **PAPER)
    np.testing.assert_allclose(result.residual_flow, [[0, -0.5, 0]] * 400, atol=1e-6)


METRE = config(pixel_size=1.0, point_cloud_range=(0.0, 0.0, -math.inf, 40.0, 40.0, math.inf), max_extent=1000.0)
# (row, column) pixels of a long L: half of its bounding box holds the whole displacement since t-2.
LONG_ELL = [(r, 10) for r in range(10, 16)] + [(15, c) for c in range(11, 30)]


def ell_at(x: float, **fields) -> Sweep:
    """A point in the middle of each 1 m pixel, displaced along x."""
    return Sweep(np.array([(c + 0.5, r + 0.5, 0.5) for r, c in LONG_ELL]) + [x, 0, 0], **fields)


def flow_x(pc1: Sweep, pc0: Sweep, *pch: Sweep, **overrides) -> float:
    (flow,) = {*flow_as_oracle(Window(pc0, pc1, pch), METRE.replace(**overrides)).residual_flow[:, 0].tolist()}
    return flow


def test_history_divides_by_the_number_of_steps():
    older = [ell_at(-4), ell_at(-7)]
    found = [flow_x(ell_at(2), ell_at(0), *older[:h], num_history=h) for h in (0, 1, 2)]
    assert found == [2.0, 2.5, 3.0]  # 2, 6 / 2, 9 / 3


def test_history_skips_a_sweep_without_the_cluster():
    gap = Sweep(np.array([[35.5, 35.5, 0.5]]))
    assert flow_x(ell_at(2), ell_at(0), gap, ell_at(-6), num_history=2) == pytest.approx((2 + 8 / 3) / 2)


def test_a_repeated_sweep_is_dropped_and_the_others_keep_their_steps():
    pc1, pc0, older = ell_at(2), ell_at(0), ell_at(-4)  # the repeat would vote 2 / 2; the older one has k = 3
    for history, expected in [((pc0,), 2.0), ((pc0, older), 2.0), ((older,), 2.5), ((ell_at(0), pc0, older), 1.75)]:
        assert flow_x(pc1, pc0, *history, num_history=3) == pytest.approx(expected)


def test_time_stamps_replace_steps_where_every_sweep_has_one():
    stamps = (300_000_000, 200_000_000, 0)
    sweeps = [ell_at(x, timestamp_ns=t) for x, t in zip((2, 0, -4), stamps)]
    assert flow_x(*sweeps, num_history=1) == 2.0  # 2, 6 / 3
    assert flow_x(*sweeps[:2], ell_at(-4), num_history=1) == 2.5  # 2, 6 / 2
    # 3 m in a step: 20 m/s need 0.1 s for a reach of 2 + 1 pixels; in 0.05 s the reach is 2 pixels.
    assert flow_x(ell_at(3), ell_at(0), max_speed=20.0) == 3.0
    assert flow_x(ell_at(3), ell_at(0), max_speed=20.0, sweep_interval=0.05) <= 2.0
    assert flow_x(ell_at(3, timestamp_ns=50_000_000), ell_at(0, timestamp_ns=0), max_speed=20.0) <= 2.0


def test_a_cluster_of_exactly_the_largest_extent_is_not_split():
    # Two pixels whose dilations touch at a corner: 6 m together.
    pair = Sweep(np.array([[5.5, 5.5, 0.5], [8.5, 8.5, 0.5]]))
    for max_extent, ids in ((6.0, [0, 0]), (5.9, [0, 1])):
        assert flow_as_oracle(Window(pair, pair), METRE.replace(max_extent=max_extent)).cluster_id.tolist() == ids


def test_score_is_that_of_the_newest_sweep():
    older = Sweep(ell_at(-1).points[:6])
    result = flow_as_oracle(Window(ell_at(0), ell_at(1), (older,)), METRE.replace(num_history=1))
    assert result.score.tolist() == [1.0] * len(LONG_ELL)


def row_of_dots(start: float, count: int = 5) -> Sweep:
    """Points 8 m apart along x: one object with 4 m pixels, separate objects with 1 m pixels."""
    return Sweep(np.array([[start + 8.0 * i, 4.5, 0.5] for i in range(count)]))


TWO_SCALES = METRE.replace(pixel_sizes=(4.0, 1.0), point_cloud_range=(0.0, 0.0, -math.inf, 80.0, 16.0, math.inf))


def test_scales_are_added():
    # 3.5 -> 10.5: columns 0 -> 2 with 4 m pixels, that is 8 m; then -1 m with 1 m pixels.
    window = Window(row_of_dots(3.5), row_of_dots(10.5))
    result = flow_as_oracle(window, TWO_SCALES)
    assert result.residual_flow[:, 0].tolist() == [7.0] * 5
    assert result.cluster_id.tolist() == [0, 1, 2, 3, 4]  # of the finest scale
    coarse = flow_as_oracle(window, TWO_SCALES.replace(pixel_sizes=(4.0,)))
    assert coarse.residual_flow[:, 0].tolist() == [8.0] * 5 and coarse.cluster_id.tolist() == [0] * 5


def test_a_point_warped_out_of_range_is_ignored_at_finer_scales():
    settings = TWO_SCALES.replace(point_cloud_range=(0.0, 0.0, -math.inf, 43.0, 16.0, math.inf))
    result = flow_as_oracle(Window(row_of_dots(3.5), row_of_dots(10.5)), settings)
    assert result.residual_flow[:, 0].tolist() == [7.0] * 4 + [8.0]  # the last point went to 43.5
    assert result.cluster_id.tolist() == [0, 1, 2, 3, -1] and result.score[4] == 0 and result.is_valid.all()


def test_older_sweeps_are_warped_by_their_steps():
    # With 4 m pixels: 8 m from t, 12 / 2 m from t-1, pooled 7 m; warped by 7 and 14 m both then lie on t+1.
    window = Window(row_of_dots(11.5, 6), row_of_dots(18.5, 6), (row_of_dots(4.5, 6),))
    result = flow_as_oracle(window, TWO_SCALES.replace(num_history=1))
    assert result.residual_flow[:, 0].tolist() == [7.0] * 6 and result.score.tolist() == [1.0] * 6


SECTIONAL = METRE.replace(sectional_view=True)


def vertical(pc0: np.ndarray, pc1: np.ndarray, settings=SECTIONAL) -> FlowResult:
    return flow_as_oracle(Window(Sweep(pc0), Sweep(pc1)), settings)


@pytest.mark.parametrize("move", [(3, 4, 1), (-4, 3, -2), (0, 2, 1), (0, 0, 2), (3, 0, 0)])
def test_a_vertical_move_is_found(move):
    pixels = [(r, 10) for r in range(10, 22)] + [(21, c) for c in range(11, 22)]
    ell = np.array([(c + 0.5, r + 0.5, 0.5) for r, c in pixels])
    points = np.concatenate([ell + [0, 0, z] for z in range(6)])
    result, flat = vertical(points, points + move), vertical(points, points + move, METRE)
    np.testing.assert_allclose(result.residual_flow, np.tile(move, (len(points), 1)), atol=1e-6)
    assert flat.residual_flow.tolist() == [[*map(float, move[:2]), 0.0]] * len(points)
    assert torch.equal(flat.score, result.score)


def test_motion_along_the_heading_is_corrected():
    # 0.8 -> 1.2: the same BEV pixel, as its grid starts at -0.25; the grid of the section starts at 0.
    settings = SECTIONAL.replace(point_cloud_range=(-0.25, 0.0, -math.inf, 20.0, 20.0, math.inf))
    before = np.array([[0.8 + i, 5.5, 0.5] for i in range(4)])
    after = before + [0.4, 0, 0]
    assert vertical(before, after, settings).residual_flow.tolist() == [[1.0, 0.0, 0.0]] * 4
    assert not vertical(before, after, settings.replace(sectional_view=False)).residual_flow.any()


def test_a_point_far_above_is_refused_with_a_hint():
    car = np.random.default_rng(0).uniform((5, 5, 0), (9, 7, 1.5), (300, 3))
    car[7, 2] = 1e5
    with pytest.raises(CFlowError, match="finite z bounds"):
        CorrelationFlow(SECTIONAL)([Window(Sweep(car), Sweep(car + [2.0, 0.0, 0.0]))])


def test_hdbscan_equals_the_oracle_in_a_batch():
    pytest.importorskip("hdbscan")
    overrides = {"min_cluster_size": 8, "pixel_sizes": (0.5, 0.25), "sectional_view": True, "max_speed": 5.0}
    settings, nothing = config(clustering="hdbscan", num_history=1, **overrides), Sweep(np.zeros((0, 3)))
    windows = [scene(seed, num_history=1) for seed in range(2)] + [Window(nothing, nothing)]
    model = CorrelationFlow(settings)
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
        assert_same(result, reference_flow(window, settings))


def test_too_few_points_form_no_hdbscan_cluster():
    few = Sweep(np.random.default_rng(0).uniform(0, 1, (8, 3)))
    (result,) = CorrelationFlow(config(clustering="hdbscan"))([Window(few, few)])
    assert (result.cluster_id == -1).all() and result.is_valid.all()


def test_a_missing_hdbscan_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "hdbscan", None)
    with pytest.raises(CFlowError, match=r"pip install hdbscan"):
        CorrelationFlow(config(clustering="hdbscan"))([scene(0)])
