"""Metrics on small made-up frames: masks, edges, empty sets, averaging, merging, tables."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any, Dict, List, Optional, Sequence

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation import (
    DEFINITIONS,
    BucketedByRange,
    BucketedEPE,
    Definition,
    EvalFrame,
    RangeWiseEPE,
    SceneFlowMetrics,
    ThreeWayEPE,
    format_table,
)
from cflow_torch.data.categories import CATEGORIES, CATEGORY_INDEX, META_CLASSES, meta_class
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window

CAR, PEDESTRIAN, SIGN = CATEGORY_INDEX["REGULAR_VEHICLE"], CATEGORY_INDEX["PEDESTRIAN"], CATEGORY_INDEX["SIGN"]
OSF, BSFE, AV2 = "opensceneflow", "bucketed_scene_flow_eval", "av2"
NAMES = [OSF, BSFE, AV2, "challenge_2026"]


def frame(
    true: Sequence[Sequence[float]],
    predicted: Optional[Sequence[Sequence[float]]] = None,
    category: Any = CAR,
    points: Optional[Any] = None,
    is_valid: Optional[Any] = None,
    **parts: Any,
) -> EvalFrame:
    """Frame without ego motion: truth and prediction are residuals; prediction 0 and points near the ego by default."""
    truth = np.asarray(true, dtype=np.float32).reshape(-1, 3)
    n = len(truth)
    labels = FlowLabels(
        flow=truth,
        category=np.broadcast_to(np.asarray(category, dtype=np.uint8), n).copy(),
        is_valid=np.ones(n, dtype=bool) if is_valid is None else np.asarray(is_valid, dtype=bool),
    )
    parts.setdefault("T_ego1_ego0", np.eye(4))
    return EvalFrame(
        points=np.ones((n, 3)) if points is None else np.asarray(points, dtype=np.float32),
        labels=labels,
        residual_flow=np.zeros((n, 3)) if predicted is None else np.asarray(predicted, dtype=np.float32),
        **parts,
    )


def scores(definition: Any, *frames: EvalFrame) -> Dict[str, Any]:
    metrics = SceneFlowMetrics(definition)
    for item in frames:
        metrics.update(item)
    return metrics.compute()


def car_counts(results: Dict[str, Any], name: str = "CAR") -> Dict[int, int]:
    counts = results["bucketed"]["classes"][name]["buckets"]["count"]
    return {bucket: count for bucket, count in enumerate(counts) if count}


def random_frames(count: int, size: int = 200) -> List[EvalFrame]:
    rng = np.random.default_rng(7)
    made = []
    for _ in range(count):
        true = rng.normal(0, 0.5, (size, 3)) * (rng.random((size, 1)) < 0.5)
        made.append(
            frame(
                true,
                true + rng.normal(0, 0.1, (size, 3)),
                category=rng.integers(0, 31, size),
                points=rng.uniform(-40, 40, (size, 3)) * [1, 1, 0.05],
                is_valid=rng.random(size) < 0.9,
                is_ground=rng.random(size) < 0.2,
            )
        )
    return made


# ---------------------------------------------------------------------------------------------- classes


def test_categories_are_the_31_of_argoverse_2() -> None:
    assert len(CATEGORIES) == 31
    assert list(CATEGORIES[1:]) == sorted(CATEGORIES[1:])  # 1-based alphabetical
    assert (CATEGORY_INDEX["REGULAR_VEHICLE"], CATEGORY_INDEX["PEDESTRIAN"], CATEGORY_INDEX["BICYCLIST"]) == (19, 17, 4)


def test_meta_classes_do_not_overlap_and_leave_signs_out() -> None:
    members = [name for group in META_CLASSES.values() for name in group]
    assert len(members) == len(set(members)) == 1 + 1 + 9 + 4 + 6
    left_out = {CATEGORIES[i] for i in np.flatnonzero(meta_class(np.arange(31)) < 0)}
    assert left_out == {
        "ANIMAL",
        "BOLLARD",
        "CONSTRUCTION_BARREL",
        "CONSTRUCTION_CONE",
        "DOG",
        "MESSAGE_BOARD_TRAILER",
        "MOBILE_PEDESTRIAN_CROSSING_SIGN",
        "SIGN",
        "STOP_SIGN",
        "TRAFFIC_LIGHT_TRAILER",
    }


def test_unknown_category_is_refused() -> None:
    with pytest.raises(CFlowError, match="0 ... 30"):
        scores(OSF, frame([[1, 0, 0]], category=31))


# ---------------------------------------------------------------------------------------------- buckets


def test_buckets_hold_their_lower_edge() -> None:
    below_one = np.nextafter(np.float32(1), np.float32(0))
    below_two = np.nextafter(np.float32(2), np.float32(0))
    for definition in (OSF, BSFE):
        speeds = [0.0, below_one, 1.0, below_two, 2.0, 7.5]
        results = scores(definition, frame([[speed, 0, 0] for speed in speeds]))
        assert car_counts(results) == {0: 1, 24: 1, 25: 1, 49: 1, 50: 2}


def test_edges_are_compared_in_float64() -> None:
    # 0.04 is stored as 0.03999999910593033 in float32, just under the edge: static.
    assert car_counts(scores(OSF, frame([[0.04, 0, 0]]))) == {0: 1}


def test_zero_prediction_has_dynamic_error_one() -> None:
    results = scores(OSF, frame([[0.3, 0, 0], [0.9, 0.1, 0], [3, 0, 0]]))
    assert results["bucketed"]["classes"]["CAR"]["dynamic_error"] == 1.0


def test_buckets_weigh_the_same_whatever_their_points() -> None:
    # 3 points at 1 m with error 0.5, one at 2.5 m with error 2.5: (0.5 + 1) / 2, not a mean over points.
    true = [[1, 0, 0]] * 3 + [[2.5, 0, 0]]
    predicted = [[0.5, 0, 0]] * 3 + [[0, 0, 0]]
    results = scores(OSF, frame(true, predicted))
    assert results["bucketed"]["classes"]["CAR"]["dynamic_error"] == pytest.approx(0.75, abs=1e-12)


def test_only_static_points() -> None:
    results = scores(OSF, frame([[0, 0, 0]] * 4, [[0.02, 0, 0]] * 4))
    car = results["bucketed"]["classes"]["CAR"]
    assert car["static_epe"] == pytest.approx(0.02, abs=1e-8)
    assert math.isnan(car["dynamic_error"])
    assert math.isnan(results["bucketed"]["classes"]["PEDESTRIAN"]["static_epe"])
    assert results["bucketed"]["mean"]["static_epe"] == car["static_epe"]
    assert math.isnan(results["bucketed"]["mean"]["dynamic_error"])


def test_moving_background_is_static_or_bucketed() -> None:
    moving = frame([[0.5, 0, 0]], category=0)
    assert car_counts(scores(OSF, moving), "BACKGROUND") == {0: 1}
    assert car_counts(scores(BSFE, moving), "BACKGROUND") == {12: 1}
    assert scores(OSF, moving)["bucketed"]["classes"]["BACKGROUND"]["static_epe"] == 0.5


def test_signs_count_as_foreground_or_not_at_all() -> None:
    sign = frame([[1, 0, 0]], category=SIGN)
    assert scores(OSF, sign)["three_way"]["epe_fd"] == pytest.approx(1.0, abs=1e-7)
    assert math.isnan(scores(BSFE, sign)["three_way"]["epe_fd"])
    assert all(row["num_dynamic"] == 0 for row in scores(OSF, sign)["bucketed"]["classes"].values())


def test_speed_edges_are_an_option() -> None:
    fast = replace(DEFINITIONS[OSF], speed_edges=(*np.linspace(0, 4, 101).tolist(), math.inf))
    assert car_counts(scores(fast, frame([[3, 0, 0]]))) == {75: 1}


# ---------------------------------------------------------------------------------------------- masks


def test_point_at_exactly_35_metres() -> None:
    on_edge = frame([[1, 0, 0]], points=[[35, 0, 0]])
    assert car_counts(scores(OSF, on_edge)) == {25: 1}
    assert car_counts(scores(BSFE, on_edge)) == {}
    assert scores(AV2, on_edge)["three_way"]["breakdown"]["foreground"]["dynamic"]["close"]["count"] == 1


def test_corner_is_in_the_box_and_outside_the_disc() -> None:
    corner = frame([[1, 0, 0]], points=[[30, 30, 0]])
    assert car_counts(scores(OSF, corner)) == {}
    assert car_counts(scores(BSFE, corner)) == {25: 1}
    box = replace(DEFINITIONS[OSF], region="box")
    assert car_counts(scores(box, corner)) == {25: 1}


def test_region_may_be_measured_at_t_plus_1() -> None:
    forward = np.eye(4)
    forward[0, 3] = -1.0  # the ego drives 1 m forward: 35.5 m ahead becomes 34.5 m
    points = np.array([[35.5, 0, 0]])
    pose_flow = ego_motion_flow(points, forward)
    item = frame(pose_flow + [[1, 0, 0]], points=points, T_ego1_ego0=forward)
    assert car_counts(scores(BSFE, item)) == {25: 1}
    assert car_counts(scores(OSF, item)) == {}


def test_rings_share_no_point() -> None:
    points = [[r, 0, 0] for r in (10, 35, 35.5, 70, 71)]
    for closed, expected in ((True, (2, 2)), (False, (1, 2))):
        inner = replace(DEFINITIONS[OSF], closed=closed)
        outer = replace(inner, min_range=35.0, max_range=70.0)
        counts = tuple(car_counts(scores(d, frame([[1, 0, 0]] * 5, points=points)))[25] for d in (inner, outer))
        assert counts == expected


@pytest.mark.parametrize("region", ["disc", "box"])
@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("axes", ["t", "t+1"])
def test_ranges_in_one_pass_equal_regions_one_by_one(region: str, closed: bool, axes: str) -> None:
    edges = (0.0, 10.0, 35.0, 70.0)
    rings = replace(DEFINITIONS["challenge_2026"], region=region, closed=closed, region_axes=axes, region_edges=edges)
    frames = random_frames(3)
    on_edges = [[10, 0, 0], [0, -35, 0], [70, 0, 0], [0, 0, 0], [35, 35, 0]]
    frames.append(frame([[1, 0, 0]] * 5, points=on_edges))
    ranges = scores(rings, *frames)["bucketed_by_range"]["ranges"]
    for low, high in zip(edges, edges[1:]):
        alone = scores(replace(rings, min_range=low, max_range=high, metrics=("bucketed",)), *frames)["bucketed"]
        expected = flat({"classes": alone["classes"], "mean": alone["mean"]})
        assert flat(ranges[f"{low:g}-{high:g}"]) == pytest.approx(expected, abs=0, rel=1e-15, nan_ok=True)
        assert alone["classes"]["CAR"]["num_dynamic"] > 0


def test_a_range_without_movers_makes_the_mean_over_ranges_nan() -> None:
    results = scores("challenge_2026", frame([[1, 0, 0]]))["bucketed_by_range"]
    assert results["ranges"]["0-35"]["mean"]["dynamic_error"] == 1.0
    assert math.isnan(results["mean"]["dynamic_error"])  # never the mean of what is left


def test_challenge_is_opensceneflow_with_ranges() -> None:
    frames = random_frames(3)
    ours, challenge = scores(OSF, *frames), scores("challenge_2026", *frames)
    for name in ("bucketed", "three_way", "range_wise"):
        assert flat(challenge[name]) == pytest.approx(flat(ours[name]), abs=0, nan_ok=True)
    corner = frame([[1, 0, 0]], points=[[30, 30, 0]])  # in the box of 35 m, outside the disc
    for definition, expected in (("challenge_2026", [0, 1]), ("challenge_2026_box", [1, 0])):
        ranges = scores(definition, corner)["bucketed_by_range"]["ranges"]
        assert [row["classes"]["CAR"]["num_dynamic"] for row in ranges.values()] == expected


def test_crop_of_bucketed_scene_flow_eval_is_open() -> None:
    points = [[1, 1, 2.5], [1, 1, 2.4], [1, 1, -2.5]]
    assert car_counts(scores(BSFE, frame([[1, 0, 0]] * 3, points=points))) == {25: 1}


def test_ground_mask_and_evaluation_mask() -> None:
    item = frame(
        [[1, 0, 0]] * 4, is_ground=[True, False, False, False], eval_mask=np.array([[True], [True], [False], [True]])
    )
    assert car_counts(scores(OSF, item)) == {25: 2}
    with_ground = replace(DEFINITIONS[OSF], exclude_ground=False)
    assert car_counts(scores(with_ground, item)) == {25: 3}


def test_av2_scores_50_metres_where_there_is_no_mask() -> None:
    item = frame([[1, 0, 0]] * 2, points=[[50, -50, 0], [50.1, 0, 0]])
    assert scores(AV2, item)["num_points"] == 1
    masked = replace(item, eval_mask=np.array([True, True]))
    assert scores(AV2, masked)["num_points"] == 2


@pytest.mark.parametrize("definition", NAMES)
def test_nothing_to_score(definition: str) -> None:
    for item in (
        frame([]),
        frame([[1, 0, 0]], is_valid=[False]),
        frame([[1, 0, 0]], is_ground=[True]),
    ):
        results = scores(definition, item)
        assert results["num_points"] == 0
        assert results["num_frames"] == 1
        assert isinstance(format_table(results), str)
        if "bucketed" in results:
            assert math.isnan(results["bucketed"]["mean"]["dynamic_error"])
    assert isinstance(format_table(SceneFlowMetrics(definition).compute()), str)


def test_nan_predictions_are_dropped_or_refused() -> None:
    item = frame([[1, 0, 0]] * 2, [[math.nan, 0, 0], [1, 0, 0]])
    results = scores(OSF, item)
    assert results["num_nan"] == 1
    assert results["bucketed"]["classes"]["CAR"]["dynamic_error"] == 0.0  # the point without an answer costs nothing
    for definition in (BSFE, AV2):
        with pytest.raises(CFlowError, match="1 scored points have NaN"):
            scores(definition, item)
        unseen = replace(item, labels=replace(item.labels, is_valid=np.array([False, True])))
        assert scores(definition, unseen)["num_points"] == 1


# ---------------------------------------------------------------------------------------------- three-way


def test_three_way_by_hand() -> None:
    item = frame(
        [[1, 0, 0], [0.5, 0, 0], [0.01, 0, 0], [0, 0, 0], [0.6, 0, 0]],
        [[0.8, 0, 0], [0.5, 0, 0], [0.11, 0, 0], [0.02, 0, 0], [0, 0, 0]],
        category=[CAR, PEDESTRIAN, CAR, 0, 0],
    )
    results = scores(replace(DEFINITIONS[OSF], average="points"), item)["three_way"]
    assert results["epe_fd"] == pytest.approx(0.1, abs=1e-7)
    assert results["epe_fs"] == pytest.approx(0.1, abs=1e-7)
    assert results["epe_bs"] == pytest.approx(0.02, abs=1e-7)
    assert results["epe_3way"] == pytest.approx(0.22 / 3, abs=1e-7)
    assert results["dynamic_iou"] == pytest.approx(2 / 4)  # hits: car, pedestrian; false: static car; miss: background
    foreground = results["breakdown"]["foreground"]["dynamic"]["all"]
    assert foreground["count"] == 2
    assert foreground["accuracy_strict"] == 0.5
    assert results["breakdown"]["background"]["dynamic"]["all"]["count"] == 1


def test_breakdown_by_class_adds_up_to_the_foreground() -> None:
    results = scores(replace(DEFINITIONS[OSF], foreground="meta", region="all"), *random_frames(3))["three_way"]
    for motion in ("static", "dynamic"):
        for distance in ("all", "close", "far"):
            whole = results["breakdown"]["foreground"][motion][distance]
            parts = [results["by_class"][name][motion][distance] for name in META_CLASSES if name != "BACKGROUND"]
            for key in ("count", "num_predicted"):
                assert sum(part[key] for part in parts) == whole[key]
            for key in ("epe", "accuracy_strict", "accuracy_relax", "angle_error"):
                total = sum(part[key] * part["count"] for part in parts if part["count"])
                assert total / whole["count"] == pytest.approx(whole[key], rel=1e-12)
    assert flat(results["by_class"]["BACKGROUND"]) == flat(results["breakdown"]["background"])


def test_accuracy_is_absolute_or_relative() -> None:
    item = frame([[2, 0, 0], [0.2, 0, 0], [2, 0, 0]], [[2.09, 0, 0], [0.29, 0, 0], [2.19, 0, 0]])
    cell = scores(OSF, item)["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]
    assert cell["accuracy_strict"] == pytest.approx(1 / 3)  # 4.5 % of 2 m
    assert cell["accuracy_relax"] == 1.0  # 9 cm; 9.5 %


def test_angle_error_is_taken_in_space_time() -> None:
    item = frame([[0.1, 0, 0]], [[0, 0, 0]])  # (0.1, 0.1 s) against (0, 0.1 s): 45 degrees
    cell = scores(OSF, item)["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]
    assert cell["angle_error"] == pytest.approx(math.pi / 4, abs=1e-6)


def test_dynamic_from_exactly_five_centimetres() -> None:
    edge = np.float32(0.05)
    below = np.nextafter(edge, np.float32(0))
    for definition in NAMES:
        breakdown = scores(definition, frame([[edge, 0, 0], [below, 0, 0]]))["three_way"]["breakdown"]
        assert breakdown["foreground"]["dynamic"]["all"]["count"] == 1
        assert breakdown["foreground"]["static"]["all"]["count"] == 1


def test_frames_without_movers_count_as_zero_or_not() -> None:
    moving, still = frame([[1, 0, 0]]), frame([[0, 0, 0]])
    by_frames = scores(OSF, moving, still)["three_way"]
    assert by_frames["epe_fd"] == pytest.approx(0.5, abs=1e-7)
    by_points = scores(replace(DEFINITIONS[OSF], average="points"), moving, still)["three_way"]
    assert by_points["epe_fd"] == 1.0
    assert math.isnan(by_points["epe_bs"])
    assert by_frames["epe_bs"] == 0.0


def test_averages_differ_on_uneven_frames() -> None:
    one, three = frame([[1, 0, 0]]), frame([[1, 0, 0]] * 3, [[1, 0, 0]] * 3)
    assert scores(OSF, one, three)["three_way"]["epe_fd"] == pytest.approx(0.5, abs=1e-7)
    assert scores(replace(DEFINITIONS[OSF], average="points"), one, three)["three_way"]["epe_fd"] == 0.25


def test_av2_rounds_to_float16() -> None:
    # Between 2 and 4 m float16 has steps of 0.00195 m.
    item = frame([[2.0009, 0, 0]], [[2.0, 0, 0]])
    assert scores(AV2, item)["three_way"]["epe_fd"] == 0.0
    exact = replace(DEFINITIONS[AV2], half_precision=False)
    assert scores(exact, item)["three_way"]["epe_fd"] == pytest.approx(0.0009, abs=1e-6)


def test_dynamic_points_may_be_predicted_apart_from_the_flow() -> None:
    item = frame([[1, 0, 0]] * 2, is_dynamic=[True, False])
    assert scores(AV2, item)["three_way"]["dynamic_iou"] == 0.5
    assert scores(AV2, replace(item, is_dynamic=None))["three_way"]["dynamic_iou"] == 0.0


# ---------------------------------------------------------------------------------------------- range-wise


def test_ranges_and_their_speed_threshold() -> None:
    points = [[0, 0, 1], [34.9, 0, 10], [35, 0, 0], [80, 0, 0], [200, 0, 0]]
    true = [[0.13, 0, 0], [0.15, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]]
    ranges = scores(OSF, frame(true, points=points, category=SIGN))["range_wise"]
    counts = {name: (row["num_static"], row["num_dynamic"]) for name, row in ranges.items() if name != "mean"}
    # height counts (34.9, 10 is 36.3 m away); 0.13 m per 0.1 s is slower than 1.4 m/s
    assert counts == {"0-35": (1, 0), "35-50": (1, 1), "50-75": (0, 0), "75-100": (0, 1), "100-inf": (0, 1)}
    assert ranges["mean"]["static_epe"] == pytest.approx(0.065, abs=1e-7)
    assert ranges["mean"]["dynamic_epe"] == pytest.approx((0.15 + 1 + 1) / 3, abs=1e-6)


# ---------------------------------------------------------------------------------------------- axes and input


def yaw(angle: float) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    T[:3, 3] = [-1.0, 0.2, 0.01]
    return T


@pytest.mark.parametrize("definition", NAMES)
def test_residual_total_and_axes_agree(definition: str) -> None:
    rng = np.random.default_rng(1)
    T, points = yaw(0.05), rng.uniform(-30, 30, (50, 3)) * [1, 1, 0.05]
    residual, predicted = rng.normal(0, 1, (2, 50, 3)).astype(np.float32)
    pose_flow = ego_motion_flow(points, T)
    labels = FlowLabels(pose_flow + residual, np.full(50, CAR, dtype=np.uint8), np.ones(50, dtype=bool))
    ways: List[Dict[str, Any]] = [
        {"residual_flow": predicted},
        {"flow": pose_flow + predicted},
        {"residual_flow": predicted @ T[:3, :3], "residual_axes": "t"},
        {"residual_flow": torch.from_numpy(predicted), "pose_flow": torch.from_numpy(pose_flow)},
    ]
    measured = []
    for way in ways:
        results = scores(definition, EvalFrame(points=points, labels=labels, T_ego1_ego0=T, **way))
        measured.append(results["three_way"]["epe_fd"])
    assert measured == pytest.approx([measured[0]] * len(ways), abs=2e-6 if definition != AV2 else 2e-5)
    direct = np.linalg.norm(predicted - residual, axis=1).mean()
    assert measured[0] == pytest.approx(direct, abs=1e-6 if definition != AV2 else 1e-3)


def test_residual_in_wrong_axes_costs_the_yaw() -> None:
    angle, T = math.radians(2.65), yaw(math.radians(2.65))
    points = np.array([[10.0, 0, 0]])
    residual = np.array([[2.0, 0, 0]], dtype=np.float32)
    labels = FlowLabels(
        (ego_motion_flow(points, T) + residual).astype(np.float32), np.array([CAR], np.uint8), np.array([True])
    )
    item = EvalFrame(points=points, labels=labels, T_ego1_ego0=T, residual_flow=residual, residual_axes="t")
    assert scores(BSFE, item)["three_way"]["epe_fd"] == pytest.approx(4 * math.sin(angle / 2), abs=1e-5)  # 9 cm


def test_frame_from_a_result() -> None:
    pose0, pose1 = np.eye(4), yaw(0.1)
    points = np.random.default_rng(0).uniform(-20, 20, (30, 3)).astype(np.float32)
    T = np.linalg.inv(pose1) @ pose0
    pose_flow = torch.from_numpy(ego_motion_flow(points, T))
    zero, mark = torch.zeros(30, 3), torch.zeros(30, dtype=torch.bool)
    result = FlowResult(zero, pose_flow, pose_flow, mark.long(), zero[:, 0], ~mark)
    ground = np.arange(30) < 10
    window = Window(Sweep(points, is_ground=ground, pose=pose0), Sweep(points, pose=pose1))
    labels = FlowLabels(pose_flow.numpy(), np.zeros(30, dtype=np.uint8), np.ones(30, dtype=bool))
    item = EvalFrame.from_result(window, result, labels)
    np.testing.assert_allclose(item.transform(), T, atol=1e-12)
    for definition in NAMES:
        results = scores(definition, item)
        assert results["num_points"] in (20, int((np.abs(points[10:, 2]) < 2.5).sum()))
        assert results["three_way"]["epe_bs"] == pytest.approx(0.0, abs=1e-5)


def test_frames_that_do_not_add_up_are_refused() -> None:
    good = frame([[1, 0, 0]] * 2)
    parts = {
        "points": good.points,
        "labels": good.labels,
        "residual_flow": good.residual_flow,
        "T_ego1_ego0": np.eye(4),
    }
    bad: List[Any] = [
        ({"residual_flow": None}, "exactly one"),
        ({"flow": np.zeros((2, 3))}, "exactly one"),
        ({"T_ego1_ego0": None}, "pose_flow or T_ego1_ego0"),
        ({"residual_flow": np.zeros((3, 3))}, "residual_flow must have shape"),
        ({"is_ground": np.zeros(5, dtype=bool)}, "is_ground must have shape"),
        ({"eval_mask": np.zeros(2)}, "eval_mask must be bool"),
        ({"points": np.zeros(6)}, "points must be"),
        ({"residual_axes": "ego"}, "residual_axes"),
        ({"labels": replace(good.labels, flow=np.zeros((1, 3)))}, "labels.flow must have shape"),
        ({"T_ego1_ego0": np.eye(3)}, "T_ego1_ego0 must have shape"),
    ]
    for change, message in bad:
        with pytest.raises(CFlowError, match=message):
            EvalFrame(**{**parts, **change})
    only_pose_flow = EvalFrame(**{**parts, "T_ego1_ego0": None, "pose_flow": np.zeros((2, 3))})
    assert car_counts(scores(OSF, only_pose_flow)) == {25: 2}
    with pytest.raises(CFlowError, match="pass T_ego1_ego0"):
        scores(BSFE, only_pose_flow)


def test_definitions_are_checked() -> None:
    for change in (
        {"region": "sphere"},
        {"metrics": ("epe",)},
        {"min_range": 40.0},
        {"speed_edges": (0.0, 1.0, 1.0)},
        {"range_edges": (0.0,)},
        {"region_edges": (35.0, 0.0)},
        {"metrics": ("bucketed_by_range",), "region": "all"},
    ):
        with pytest.raises(CFlowError):
            Definition(**{"name": "mine", **change})  # type: ignore[arg-type]
    with pytest.raises(CFlowError, match="opensceneflow"):
        SceneFlowMetrics("kitti")


# ---------------------------------------------------------------------------------------------- streaming


def flat(value: Any) -> List[float]:
    if isinstance(value, dict):
        return [number for key in sorted(value) for number in flat(value[key])]
    if isinstance(value, (list, tuple)):
        return [number for item in value for number in flat(item)]
    return [] if isinstance(value, str) else [float(value)]


@pytest.mark.parametrize("definition", NAMES)
@settings(max_examples=15, deadline=None)
@given(order=st.permutations(range(5)), cut=st.integers(0, 5))
def test_order_and_merging_do_not_matter(definition: str, order: List[int], cut: int) -> None:
    frames = random_frames(5, size=60)
    first, second = SceneFlowMetrics(definition), SceneFlowMetrics(definition)
    for place, index in enumerate(order):
        (first if place < cut else second).update(frames[index])
    first.merge(second)
    expected = flat(scores(definition, *frames))
    assert flat(first.compute()) == pytest.approx(expected, rel=1e-12, abs=1e-12, nan_ok=True)


def test_order_of_points_does_not_matter() -> None:
    (item,) = random_frames(1)
    order = np.random.default_rng(0).permutation(len(item.points))
    shuffled = replace(
        item,
        points=item.points[order],
        labels=FlowLabels(*(getattr(item.labels, name)[order] for name in ("flow", "category", "is_valid"))),
        residual_flow=item.residual_flow[order],
        pose_flow=item.pose_flow[order],
        is_ground=item.is_ground[order],
    )
    for definition in NAMES:
        expected = flat(scores(definition, item))
        assert flat(scores(definition, shuffled)) == pytest.approx(expected, rel=1e-12, abs=1e-12, nan_ok=True)


def test_parts_alone_equal_the_bundle() -> None:
    frames = random_frames(3)
    bundle = scores("challenge_2026", *frames)
    kinds = {
        "bucketed": BucketedEPE,
        "bucketed_by_range": BucketedByRange,
        "three_way": ThreeWayEPE,
        "range_wise": RangeWiseEPE,
    }
    for name, kind in kinds.items():
        part, other = kind("challenge_2026"), kind("challenge_2026")
        part.update(frames[0])
        for item in frames[1:]:
            other.update(item)
        part.merge(other)
        assert flat(part.compute()) == pytest.approx(flat(bundle[name]), rel=1e-12, nan_ok=True)


def test_merging_other_definitions_is_refused() -> None:
    other = replace(DEFINITIONS[OSF], max_range=50.0)
    for kind in (SceneFlowMetrics, BucketedEPE, BucketedByRange, ThreeWayEPE, RangeWiseEPE):
        with pytest.raises(CFlowError, match="cannot merge"):
            kind(OSF).merge(kind(other))


def test_results_are_plain() -> None:
    results = scores(OSF, *random_frames(2))
    assert json.loads(json.dumps(results))["num_frames"] == 2


# ---------------------------------------------------------------------------------------------- tables


def test_table_shows_every_class_and_no_nan() -> None:
    text = format_table(scores(OSF, frame([[1, 0, 0], [0, 0, 0]], category=[CAR, 0])))
    for name in (*META_CLASSES, "**mean**", "EPE 3-way", "35-50"):
        assert name in text
    assert "nan" not in text
    row = next(line for line in text.splitlines() if line.startswith("| CAR"))
    assert [cell.strip() for cell in row.strip("|").split("|")] == ["CAR", "-", "1.0000", "0", "1"]
    widths = {len(line) for line in text.splitlines()[2:9]}
    assert len(widths) == 1  # columns line up


def test_table_of_ranges() -> None:
    item = frame([[1, 0, 0]] * 2, [[0, 0, 0], [0.5, 0, 0]], points=[[10, 0, 0], [50, 0, 0]])
    lines = format_table(scores("challenge_2026", item)).splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    start = next(i for i, row in enumerate(rows) if row[0].startswith("dynamic error, range"))
    assert rows[start + 2] == ["0-35", "1.0000", "-", "-", "-", "1.0000"]
    assert rows[start + 3] == ["35-70", "0.5000", "-", "-", "-", "0.5000"]
    assert rows[start + 4] == ["**mean**", "", "", "", "", "0.7500"]


def test_table_leaves_out_what_a_definition_lacks() -> None:
    text = format_table(scores(AV2, frame([[1, 0, 0]])))
    assert "EPE 3-way" in text
    assert "PEDESTRIAN" not in text
    assert "35-50" not in text
