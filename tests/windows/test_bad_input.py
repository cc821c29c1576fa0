"""Bad input: points that cannot take part give zeros, everything else one error type that names the thing."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle import reference_flow
from scenes import RANGE, assert_same, assert_zeros, config, pose, scene

from cflow_torch import CFlowError, CorrelationFlow, Sweep, Window, estimate_flow, make_config

RNG = np.random.default_rng(0)
P0 = RNG.uniform(-5, 5, (50, 3)).astype(np.float32)
P1 = RNG.uniform(-5, 5, (40, 3)).astype(np.float32)
EYE = np.eye(4)
MIRROR = np.diag([1.0, 1.0, -1.0, 1.0])


# ------------------------------------------------------------------------------- points that cannot take part


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", [0, 1, 2])
def test_points_that_are_not_finite_are_left_out(column, bad):
    clean = scene(11, num_history=1)
    rows = np.array([3, 100, 101, 400])
    model = CorrelationFlow(config(num_history=1))

    def broken(sweep: Sweep) -> Sweep:
        points = sweep.points.copy()
        points[rows, column] = bad
        return replace(sweep, points=points)

    def without(sweep: Sweep) -> Sweep:
        return replace(sweep, points=np.delete(sweep.points, rows, 0), is_ground=np.delete(sweep.is_ground, rows))

    (result,) = model([Window(broken(clean.pc0), broken(clean.pc1), (broken(clean.pch[0]),))])
    (expected,) = model([Window(without(clean.pc0), without(clean.pc1), (without(clean.pch[0]),))])
    keep = np.ones(len(clean.pc0.points), dtype=bool)
    keep[rows] = False
    for name, value in vars(result).items():  # the other rows do not notice
        if value is None:
            continue
        assert torch.equal(value[torch.from_numpy(keep)], getattr(expected, name)), name
        assert torch.isfinite(value.double()).all(), name
        fill = -1 if name == "cluster_id" else 0
        assert (value[torch.from_numpy(rows)] == fill).all(), name


EMPTY = np.zeros((0, 3), dtype=np.float32)
ONE = np.array([[1.0, 2.0, 0.5]], dtype=np.float32)
FAR = P0 + np.float32(1000)


@pytest.mark.parametrize("with_pose", [False, True])
@pytest.mark.parametrize("overrides", [{}, {"sectional_view": True, "pixel_sizes": (0.4, 0.2), "max_speed": 5.0}])
@pytest.mark.parametrize(
    "pc0, pc1, pch",
    [
        (EMPTY, P1, ()),
        (P0, EMPTY, ()),
        (EMPTY, EMPTY, ()),
        (EMPTY, EMPTY, (EMPTY, EMPTY)),
        (EMPTY, P1, (P0,)),
        (P0, EMPTY, (P1,)),
        (ONE, ONE + 100, ()),
        (ONE, EMPTY, (ONE + 1,)),
        (ONE, ONE + 3, ()),
        (FAR, FAR, ()),
        (FAR, P1, ()),
        (P0, FAR, (P1,)),
        (P0 * np.nan, P1, ()),
        (P0, P1 * np.nan, ()),
    ],
)
def test_nothing_to_find_gives_zeros_of_the_right_shape(pc0, pc1, pch, overrides, with_pose):
    T_world_ego = pose(1, 2, 0.3) if with_pose else None
    sweeps = [Sweep(p, pose=T_world_ego) for p in (pc0, pc1, *pch)]
    window = Window(sweeps[0], sweeps[1], tuple(sweeps[2:]))
    settings = config(num_history=2, **overrides)
    (result,) = CorrelationFlow(settings)([window])
    assert_zeros(result, len(pc0))
    assert_same(result, reference_flow(window, settings))
    low, high = np.array(RANGE[:3]), np.array(RANGE[3:])
    assert result.is_valid.tolist() == [bool(((p >= low) & (p <= high)).all()) for p in pc0]


def test_everything_ground():
    result = estimate_flow(P0, P0 + np.float32(0.5), gm0=np.ones(50, dtype=bool), gm1=np.ones(50, dtype=bool))
    assert_zeros(result, 50)
    assert not result.is_valid.any()
    result = estimate_flow(P0, P0 + np.float32(0.5), gm1=np.ones(50, dtype=bool))
    assert_zeros(result, 50)
    assert result.is_valid.all()


def test_one_point_in_each_sweep_is_a_cluster():
    result = estimate_flow(ONE, ONE)
    assert result.cluster_id.tolist() == [0] and result.score.tolist() == [1.0] and not result.flow.any()


def test_ground_and_far_points_keep_their_pose_flow():
    T_ego1_ego0 = pose(-1.0, 0.5, 0.1)
    points = np.concatenate([FAR[:2], P0[:3]]).astype(np.float64)
    ground = np.array([False, True, True, False, False])
    result = estimate_flow(points, P1, T_ego1_ego0=T_ego1_ego0, gm0=ground)
    expected = points @ T_ego1_ego0[:3, :3].T + T_ego1_ego0[:3, 3] - points
    assert np.allclose(result.pose_flow.numpy(), expected, atol=1e-5)
    assert result.is_valid.tolist() == [False, False, False, True, True]
    assert torch.equal(result.flow[:3], result.pose_flow[:3])


# --------------------------------------------------------------------------------------------- estimate_flow


@pytest.mark.parametrize("moved", [{}, {"T_ego1_ego0": EYE}], ids=["compensated", "with transform"])
@pytest.mark.parametrize(
    "points, complaint",
    [
        (P0[:, :2], r"shape \(50, 2\).*\(N, 3\+\)"),
        (P0[None], r"shape \(1, 50, 3\)"),
        (P0[0], r"shape \(3,\)"),
        (P0.astype(np.int64), "dtype int64.*float"),
        (P0.astype(complex), "dtype complex128"),
        (P0.astype(object), "dtype object"),
        (P0 > 0, "dtype bool"),
        (torch.from_numpy(P0).int(), "dtype torch.int32"),
        (P0.tolist(), "is list"),
        (None, "is NoneType"),
        ("points.npy", "is str"),
    ],
)
def test_points_of_the_wrong_kind(points, complaint, moved):
    more = {"T_ego1_egoh": [EYE], **moved} if moved else {}
    with pytest.raises(CFlowError, match="pc0.*" + complaint):
        estimate_flow(points, P1, **moved)
    with pytest.raises(CFlowError, match="pc1.*" + complaint):
        estimate_flow(P0, points, **moved)
    with pytest.raises(CFlowError, match="pch1.*" + complaint):
        estimate_flow(P0, P1, pch=[points], num_history=1, **more)


@pytest.mark.parametrize(
    "transform, complaint",
    [
        (EYE[None], r"shape \(1, 4, 4\).*no batch"),
        (EYE[:3], r"shape \(3, 4\)"),
        (EYE * np.nan, "NaN"),
        (np.diag([np.inf, 1, 1, 1]), "inf"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "not rigid"),
        (MIRROR, "not rigid"),
        (pose(5, 0, 0).T, "not rigid"),
        ("identity", "is str"),
        (torch.zeros(4, 4), "not rigid"),
    ],
)
def test_transforms_that_are_none(transform, complaint):
    with pytest.raises(CFlowError, match="(pc0|T_ego1_ego0).*" + complaint):
        estimate_flow(P0, P1, T_ego1_ego0=transform)
    with pytest.raises(CFlowError, match="(pch1|T_ego1_egoh).*" + complaint):
        estimate_flow(P0, P1, T_ego1_ego0=EYE, pch=[P0 + 1], T_ego1_egoh=[transform], num_history=1)


@pytest.mark.parametrize(
    "mask, complaint",
    [
        (np.zeros(3, dtype=bool), r"shape \(3,\)"),
        (np.zeros((50, 1), dtype=bool), r"shape \(50, 1\)"),
        (np.zeros(50), "dtype float64.*bool"),
        (np.zeros(50, dtype=np.uint8), "dtype uint8.*bool"),
        (torch.zeros(50), "dtype torch.float32.*bool"),
        ([False] * 50, "is list"),
        ("auto", "is str"),
    ],
)
def test_ground_masks_of_the_wrong_kind(mask, complaint):
    with pytest.raises(CFlowError, match="ground mask of pc0.*" + complaint):
        estimate_flow(P0, P0, gm0=mask)
    with pytest.raises(CFlowError, match="ground mask of pc1.*" + complaint):
        estimate_flow(P0, P0, gm1=mask)
    with pytest.raises(CFlowError, match="ground mask of pch1.*" + complaint):
        estimate_flow(P0, P0, pch=[P0 + 1], gmh=[mask], num_history=1)


@pytest.mark.parametrize(
    "arguments, complaint",
    [
        ({"pch": [P1, P0], "preset": "paper"}, "2 history sweeps.*num_history=0"),
        ({"pch": [P1, P0], "num_history": 1}, "2 history sweeps.*num_history=1"),
        ({"pch": [P1], "num_history": 1, "gmh": [None, None]}, "gmh has 2 entries for 1"),
        ({"pch": [P1], "num_history": 1, "T_ego1_egoh": [EYE, EYE]}, "T_ego1_egoh has 2 entries for 1"),
        ({"gmh": [None]}, "gmh has 1 entries for 0"),
        ({"pch": [P1], "num_history": 1, "T_ego1_ego0": EYE}, "T_ego1_egoh"),
        ({"pch": P1, "num_history": 1}, "pch|history"),
        ({"pch": P1[None], "num_history": 1, "T_ego1_ego0": EYE, "T_ego1_egoh": EYE[None]}, None),
        ({"max_hight": 3}, "max_hight.*pixel_size.*pixel_sizes.*num_history.*gate_radius"),
        ({"pixel_size": 0.1, "pixel_sizes": (0.2, 0.1)}, "pixel_size and pixel_sizes"),
        ({"preset": "paperr"}, "preset='paperr'.*default.*paper|preset='paperr'.*paper.*default"),
        ({"method": "fast"}, "method='fast'.*dense"),
        ({"method": "keypoints", "num_history": 1}, "one pair of sweeps"),
        ({"patch_size": 53}, "at most 51"),
        ({"ratio_threshold": 2.5}, "from 1 to 2"),
        ({"second_best_distance": -1.0}, "second_best_distance=-1.0"),
        ({"mutual_check": "yes"}, "mutual_check"),
        ({"densify": "median"}, "components"),
        ({"clustering": "kmeans"}, "clustering='kmeans'.*components"),
        ({"ground": "yes"}, "ground='yes'.*'auto'"),
        ({"device": "abacus"}, "device='abacus'"),
        ({"device": None}, "device=None"),
        ({"pixel_size": 1e-5}, "point_cloud_range"),
    ],
)
def test_arguments(arguments, complaint):
    if complaint is None:  # a stack of sweeps is a sequence of sweeps
        estimate_flow(P0, P1, **arguments)
        return
    with pytest.raises(CFlowError, match=complaint):
        estimate_flow(P0, P1, **arguments)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpu_that_is_not_there():
    with pytest.raises(CFlowError, match="device='cuda'"):
        estimate_flow(P0, P1, device="cuda")


def test_mixed_devices():
    cpu, other = torch.from_numpy(P0), torch.from_numpy(P1).to("meta")
    mask = torch.zeros(50, dtype=torch.bool, device="meta")
    for call in (
        lambda: estimate_flow(cpu, other),
        lambda: estimate_flow(other, cpu),
        lambda: estimate_flow(cpu, cpu, gm1=mask),
        lambda: estimate_flow(cpu, cpu, pch=[other], num_history=1),
        lambda: CorrelationFlow(make_config())([Window(Sweep(cpu), Sweep(cpu)), Window(Sweep(other), Sweep(other))]),
    ):
        with pytest.raises(CFlowError, match=r"different devices \(cpu, meta\)"):
            call()


def test_coordinates_in_rows_instead_of_columns():
    with pytest.raises(CFlowError, match="give its transpose"):
        estimate_flow(np.zeros((3, 1001)), P1)
    estimate_flow(np.zeros((3, 1000)), P1)


@pytest.mark.parametrize(
    ("points", "masks", "seen"),
    [
        (1000 * P0.astype(np.float64) + 1e6, {}, "they span x (99|100)"),
        (np.full((4, 3), np.nan), {}, "all are NaN or infinite"),
        (P0, {"gm0": np.ones(len(P0), bool)}, "not all of them ground"),
    ],
    ids=["millimetres", "nothing finite", "all ground"],
)
def test_a_warning_if_no_point_takes_part(points, masks, seen):
    with pytest.warns(UserWarning, match="none of the .* points of pc0 takes part") as caught:
        result = estimate_flow(points, P1, **masks)
    assert not result.is_valid.any() and re.search(seen, str(caught[0].message))


def test_no_such_warning_otherwise():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate_flow(P0, P1)
        estimate_flow(P0[:0], P1)


# ------------------------------------------------------------------------------------------------- the module


@pytest.mark.parametrize(
    "windows",
    [
        None,
        3,
        Window(Sweep(P0), Sweep(P1)),
        [Sweep(P0)],
        [P0, P1],
        P0,
        [Window(P0, P1)],
        [Window(Sweep(P0), None)],
        [Window(Sweep(P0), Sweep(P1), None)],
        [Window(Sweep(P0), Sweep(P1), (P0,))],
    ],
    ids=lambda w: type(w).__name__,
)
def test_what_is_no_list_of_windows(windows):
    with pytest.raises(CFlowError, match="Window|Sweep"):
        CorrelationFlow.from_preset("paper", num_history=1)(windows)


def test_no_windows_no_results():
    assert CorrelationFlow.from_preset("paper")([]) == []


@pytest.mark.parametrize("settings", [None, {"pixel_sizes": (0.1,)}, "paper"])
def test_what_is_no_config(settings):
    with pytest.raises(CFlowError, match="Config"):
        CorrelationFlow(settings)


@pytest.mark.parametrize("given", [(0,), (1,), (2,), (0, 1), (0, 2), (1, 2)])
def test_poses_of_some_sweeps_only(given):
    sweeps = [Sweep(p, pose=EYE if i in given else None) for i, p in enumerate((P0, P1, P0 + 1))]
    with pytest.raises(CFlowError, match="pose"):
        CorrelationFlow.from_preset("paper", num_history=1)([Window(sweeps[0], sweeps[1], (sweeps[2],))])


@pytest.mark.parametrize("which, name", [(0, "pc0"), (1, "(pose1|pc1)"), (2, "pch1")])
@pytest.mark.parametrize("bad", [EYE * np.nan, MIRROR, EYE[None], np.eye(3), "pose"], ids=repr)
def test_bad_poses_are_named(bad, which, name):
    sweeps = [Sweep(p, pose=bad if i == which else EYE) for i, p in enumerate((P0, P1, P0 + 1))]
    with pytest.raises(CFlowError, match=name):
        CorrelationFlow.from_preset("paper", num_history=1)([Window(sweeps[0], sweeps[1], (sweeps[2],))])


def test_poses_of_another_log():
    with pytest.raises(CFlowError, match="pc0"):
        estimate_flow(P0, P1, T_ego1_ego0=pose(5000.0, 100.0, 0.0))


@pytest.mark.parametrize("stamps", [(0, 0, -1), (0, 1, -1), (0, -1, 1), (0, -1, -1)])
def test_time_stamps_out_of_order(stamps):
    sweeps = [Sweep(p, timestamp_ns=10**9 + 10**8 * s) for p, s in zip((P1, P0, P0 + 1), stamps)]
    with pytest.raises(CFlowError, match="time stamps"):
        CorrelationFlow.from_preset("paper", num_history=1)([Window(sweeps[1], sweeps[0], (sweeps[2],))])


def test_a_gap_in_the_history():
    sweeps = [Sweep(p, timestamp_ns=10**9 - 10**8 * s) for p, s in zip((P1, P0, P0 + 1), (0, 1, 9))]
    window = Window(sweeps[1], sweeps[0], (sweeps[2],))
    with pytest.raises(CFlowError, match="use_timestamps"):
        CorrelationFlow.from_preset("paper", num_history=1)([window])
    assert len(CorrelationFlow.from_preset("paper", num_history=1, use_timestamps=True)([window])) == 1


def test_the_error_is_a_value_error_with_a_remedy():
    with pytest.raises(ValueError) as caught:
        estimate_flow(P0[:, :2], P1)
    assert "give" in str(caught.value)
