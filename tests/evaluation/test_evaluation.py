"""Metrics on small made-up frames: masks, edges, empty sets, averages, merging, tables, several data sets."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from public_evaluators import score
from scenes import pose

from cflow_torch.cli.comparison import summary
from cflow_torch.cli.eval import objective
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation import EvalFrame, SceneFlowMetrics, errors_by_range, format_table, score_data_sets
from cflow_torch.evaluation.definitions import DEFINITIONS
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.types import CFlowError

CAR, PEDESTRIAN, SIGN = CATEGORY_INDEX["REGULAR_VEHICLE"], CATEGORY_INDEX["PEDESTRIAN"], CATEGORY_INDEX["SIGN"]
OSF, BSFE, AV2 = "opensceneflow", "bucketed_scene_flow_eval", "av2"
NAMES = [OSF, BSFE, AV2, "challenge_2026"]
BY_POINTS = replace(DEFINITIONS[OSF], average="points")


def frame(
    true: Any, predicted: Any = 0.0, category: Any = CAR, points: Any = 1.0, is_valid: Any = True, **parts: Any
) -> EvalFrame:
    """Make a frame without ego motion from true and predicted residuals, by default with points near the ego."""
    truth = np.asarray(true, dtype=np.float32).reshape(-1, 3)
    n = len(truth)
    category, is_valid = (np.full(n, value, kind) for value, kind in ((category, np.uint8), (is_valid, bool)))
    given = {"points": np.full((n, 3), points), "residual_flow": np.full((n, 3), predicted), "T_ego1_ego0": np.eye(4)}
    return EvalFrame(labels=FlowLabels(truth, category, is_valid), **{**given, **parts})


def scores(definition: Any, *frames: EvalFrame) -> dict[str, Any]:
    return score(definition, frames)


def counts(results: dict[str, Any], name: str = "CAR") -> dict[int, int]:
    """Bucket -> number of points, for buckets that have any."""
    buckets = results["bucketed"]["classes"][name]["buckets"]["count"]
    return {bucket: count for bucket, count in enumerate(buckets) if count}


def flat(value: Any) -> list[float]:
    """Every number, in the order of sorted names."""
    if isinstance(value, dict):
        return [number for key in sorted(value) for number in flat(value[key])]
    if isinstance(value, (list, tuple)):
        return [number for item in value for number in flat(item)]
    return [] if isinstance(value, str) else [float(value)]


def close_to(value: Any) -> Any:
    return pytest.approx(flat(value), rel=1e-12, abs=1e-12, nan_ok=True)


def random_frames(count: int, size: int = 200) -> list[EvalFrame]:
    rng = np.random.default_rng(7)
    made = []
    for _ in range(count):
        true = rng.normal(0, 0.5, (size, 3)) * (rng.random((size, 1)) < 0.5)
        points, category = rng.uniform(-40, 40, (size, 3)) * [1, 1, 0.05], rng.integers(0, 31, size)
        is_valid, is_ground = rng.random(size) < 0.9, rng.random(size) < 0.2
        made.append(frame(true, true + rng.normal(0, 0.1, (size, 3)), category, points, is_valid, is_ground=is_ground))
    return made


def test_buckets_contain_their_lower_edge() -> None:
    below_one, below_two = (np.nextafter(np.float32(edge), np.float32(0)) for edge in (1, 2))
    speeds = [0.0, below_one, 1.0, below_two, 2.0, 7.5]
    for definition in (OSF, BSFE):
        found = counts(scores(definition, frame([[speed, 0, 0] for speed in speeds])))
        assert found == {0: 1, 24: 1, 25: 1, 49: 1, 50: 2}
    # 0.04 is 0.03999999910593033 in float32. Edges are compared in float64, so it is just static.
    assert counts(scores(OSF, frame([[0.04, 0, 0]]))) == {0: 1}
    finer = replace(DEFINITIONS[OSF], speed_edges=(*np.linspace(0, 4, 101).tolist(), math.inf))
    assert counts(scores(finer, frame([[3, 0, 0]]))) == {75: 1}


def test_buckets_have_equal_weight_and_a_residual_of_zero_scores_one() -> None:
    # 3 points at 1 m with error 0.5, one at 2.5 m with error 2.5: (0.5 + 1) / 2, not a mean over points.
    true = [[1, 0, 0]] * 3 + [[2.5, 0, 0]]
    car = scores(OSF, frame(true, [[0.5, 0, 0]] * 3 + [[0, 0, 0]]))["bucketed"]["classes"]["CAR"]
    assert car["dynamic_error"] == pytest.approx(0.75, abs=1e-12)
    static = scores(OSF, frame([[0.3, 0, 0], [0.9, 0.1, 0], [3, 0, 0]]))
    assert static["bucketed"]["classes"]["CAR"]["dynamic_error"] == 1.0


def test_moving_background_is_static_or_bucketed() -> None:
    moving = frame([[0.5, 0, 0]], category=0)
    assert counts(scores(OSF, moving), "BACKGROUND") == {0: 1}
    assert counts(scores(BSFE, moving), "BACKGROUND") == {12: 1}
    assert scores(OSF, moving)["bucketed"]["classes"]["BACKGROUND"]["static_epe"] == 0.5


def test_edges_of_regions() -> None:
    on_edge, corner = (frame([[1, 0, 0]], points=[point]) for point in ([35, 0, 0], [30, 30, 0]))
    assert counts(scores(OSF, on_edge)) == {25: 1} and counts(scores(OSF, corner)) == {}  # disc, closed
    assert counts(scores(BSFE, on_edge)) == {} and counts(scores(BSFE, corner)) == {25: 1}  # box, open
    assert counts(scores(replace(DEFINITIONS[OSF], region="box"), corner)) == {25: 1}
    assert scores(AV2, on_edge)["three_way"]["breakdown"]["foreground"]["dynamic"]["close"]["count"] == 1
    heights = frame([[1, 0, 0]] * 3, points=[[1, 1, 2.5], [1, 1, 2.4], [1, 1, -2.5]])
    assert counts(scores(BSFE, heights)) == {25: 1}, "its crop is an open interval"


@pytest.mark.parametrize("region", ["disc", "box"])
@pytest.mark.parametrize("closed", [True, False])
def test_ranges_in_one_pass_equal_separate_scores_of_their_points(region: str, closed: bool) -> None:
    edges = (0.0, 10.0, 35.0, 70.0)
    rings = replace(DEFINITIONS["challenge_2026"], region=region, closed=closed, region_edges=edges)
    on_edges = [[10, 0, 0], [0, -35, 0], [70, 0, 0], [0, 0, 0], [35, 35, 0]]
    frames = [*random_frames(3), frame([[1, 0, 0]] * 5, points=on_edges)]
    ranges = scores(rings, *frames)["bucketed_by_range"]["ranges"]
    for low, high in zip(edges, edges[1:]):
        inside = []
        for item in frames:
            x, y = np.abs(item.points[:, :2].astype(np.float64).T)
            reach = np.maximum(x, y) if region == "box" else np.hypot(x, y)
            is_in = (low < reach) & (reach <= high) if closed else (low <= reach) & (reach < high)
            inside.append(replace(item, eval_mask=is_in | (closed & (low == 0) & (reach == 0))))
        alone = scores(replace(rings, max_range=math.inf, metrics=("bucketed",)), *inside)["bucketed"]
        expected = {"classes": alone["classes"], "mean": alone["mean"]}
        assert flat(ranges[f"{low:g}-{high:g}"]) == close_to(expected)
        assert alone["classes"]["CAR"]["num_dynamic"] > 0


def test_ground_mask_and_evaluation_mask() -> None:
    masks = {"is_ground": [True, False, False, False], "eval_mask": [True, True, False, True]}
    item = frame([[1, 0, 0]] * 4, **masks)
    assert counts(scores(OSF, item)) == {25: 2}
    far = frame([[1, 0, 0]] * 2, points=[[50, -50, 0], [50.1, 0, 0]])  # without a mask, av2 scores points within 50 m
    assert scores(AV2, far)["num_points"] == 1
    assert scores(AV2, replace(far, eval_mask=np.array([True, True])))["num_points"] == 2


@pytest.mark.parametrize("definition", NAMES)
def test_nothing_to_score(definition: str) -> None:
    for item in (frame([]), frame([[1, 0, 0]], is_valid=[False]), frame([[1, 0, 0]], is_ground=[True])):
        results = scores(definition, item)
        assert (results["num_points"], results["num_frames"]) == (0, 1)
        assert "nan" not in format_table(results)
        if "bucketed" in results:
            assert math.isnan(results["bucketed"]["mean"]["dynamic_error"])
    assert isinstance(format_table(SceneFlowMetrics(definition).compute()), str)


def test_nan_predictions_are_ignored_or_an_error() -> None:
    item = frame([[1, 0, 0]] * 2, [[math.nan, 0, 0], [1, 0, 0]])
    results = scores(OSF, item)
    assert results["num_nan"] == 1
    assert results["bucketed"]["classes"]["CAR"]["dynamic_error"] == 0.0  # the point with NaN has no effect
    for definition in (BSFE, AV2):
        with pytest.raises(CFlowError, match="1 scored points have NaN"):
            scores(definition, item)
        unseen = replace(item, labels=replace(item.labels, is_valid=np.array([False, True])))
        assert scores(definition, unseen)["num_points"] == 1


def test_three_way_by_hand() -> None:
    item = frame(
        [[1, 0, 0], [0.5, 0, 0], [0.01, 0, 0], [0, 0, 0], [0.6, 0, 0]],
        [[0.8, 0, 0], [0.5, 0, 0], [0.11, 0, 0], [0.02, 0, 0], [0, 0, 0]],
        category=[CAR, PEDESTRIAN, CAR, 0, 0],
    )
    results = scores(BY_POINTS, item)["three_way"]
    found = [results[key] for key in ("epe_fd", "epe_fs", "epe_bs", "epe_3way")]
    assert found == pytest.approx([0.1, 0.1, 0.02, 0.22 / 3], abs=1e-7)
    assert results["dynamic_iou"] == pytest.approx(2 / 4)  # hits: car, pedestrian; false: static car; miss: background
    foreground = results["breakdown"]["foreground"]["dynamic"]["all"]
    assert (foreground["count"], foreground["accuracy_strict"]) == (2, 0.5)
    assert results["breakdown"]["background"]["dynamic"]["all"]["count"] == 1


def test_accuracy_is_absolute_or_relative_and_the_angle_is_in_space_time() -> None:
    item = frame([[2, 0, 0], [0.2, 0, 0], [2, 0, 0]], [[2.09, 0, 0], [0.29, 0, 0], [2.19, 0, 0]])
    cell = scores(OSF, item)["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]
    assert cell["accuracy_strict"] == pytest.approx(1 / 3)  # 4.5 % of 2 m
    assert cell["accuracy_relax"] == 1.0  # 9 cm; 9.5 %
    rotated = scores(OSF, frame([[0.1, 0, 0]], [[0, 0, 0]]))  # (0.1 m, 0.1 s) against (0, 0.1 s): 45 degrees
    cell = rotated["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]
    assert cell["angle_error"] == pytest.approx(math.pi / 4, abs=1e-6)


@pytest.mark.parametrize("definition", NAMES)
def test_dynamic_from_exactly_five_centimetres(definition: str) -> None:
    edge = np.float32(0.05)
    below = np.nextafter(edge, np.float32(0))
    foreground = scores(definition, frame([[edge, 0, 0], [below, 0, 0]]))["three_way"]["breakdown"]["foreground"]
    assert foreground["dynamic"]["all"]["count"] == foreground["static"]["all"]["count"] == 1


def test_average_over_frames_or_points() -> None:
    moving, static, correct = frame([[1, 0, 0]]), frame([[0, 0, 0]]), frame([[1, 0, 0]] * 3, [[1, 0, 0]] * 3)
    by_frames, by_points = (scores(definition, moving, static)["three_way"] for definition in (OSF, BY_POINTS))
    assert by_frames["epe_fd"] == pytest.approx(0.5, abs=1e-7) and by_frames["epe_bs"] == 0.0  # absent counts as 0
    assert by_points["epe_fd"] == 1.0 and math.isnan(by_points["epe_bs"])
    assert scores(OSF, moving, correct)["three_way"]["epe_fd"] == pytest.approx(0.5, abs=1e-7)
    assert scores(BY_POINTS, moving, correct)["three_way"]["epe_fd"] == 0.25


def test_ranges_and_their_speed_threshold() -> None:
    points = [[0, 0, 1], [34.9, 0, 10], [35, 0, 0], [80, 0, 0], [200, 0, 0]]
    true = [[0.13, 0, 0], [0.15, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]]
    ranges = scores(OSF, frame(true, points=points, category=SIGN))["range_wise"]
    found = {name: (row["num_static"], row["num_dynamic"]) for name, row in ranges.items() if name != "mean"}
    # height counts (34.9, 10 is 36.3 m away); 0.13 m per 0.1 s is slower than 1.4 m/s
    assert found == {"0-35": (1, 0), "35-50": (1, 1), "50-75": (0, 0), "75-100": (0, 1), "100-inf": (0, 1)}
    assert ranges["mean"]["static_epe"] == pytest.approx(0.065, abs=1e-7)
    assert ranges["mean"]["dynamic_epe"] == pytest.approx((0.15 + 1 + 1) / 3, abs=1e-6)


@pytest.mark.parametrize("definition", NAMES)
def test_residual_total_and_axes_agree(definition: str) -> None:
    rng = np.random.default_rng(1)
    T, points = pose(-1.0, 0.2, 0.05, 0.01), rng.uniform(-30, 30, (50, 3)) * [1, 1, 0.05]
    residual, predicted = rng.normal(0, 1, (2, 50, 3)).astype(np.float32)
    pose_flow = ego_motion_flow(points, T)
    labels = FlowLabels(pose_flow + residual, np.full(50, CAR, dtype=np.uint8), np.ones(50, dtype=bool))
    forms: list[dict[str, Any]] = [
        {"residual_flow": predicted},
        {"flow": pose_flow + predicted},
        {"residual_flow": predicted @ T[:3, :3], "residual_axes": "t"},
        {"residual_flow": torch.from_numpy(predicted), "pose_flow": torch.from_numpy(pose_flow)},
    ]
    frames = [EvalFrame(points=points, labels=labels, T_ego1_ego0=T, **form) for form in forms]
    measured = [scores(definition, item)["three_way"]["epe_fd"] for item in frames]
    assert measured == pytest.approx([measured[0]] * len(forms), abs=2e-6 if definition != AV2 else 2e-5)
    direct = np.linalg.norm(predicted - residual, axis=1).mean()
    assert measured[0] == pytest.approx(direct, abs=1e-6 if definition != AV2 else 1e-3)


def test_contradictory_frames_are_an_error() -> None:
    good = frame([[1, 0, 0]] * 2)
    parts = {name: getattr(good, name) for name in ("points", "labels", "residual_flow", "T_ego1_ego0")}
    bad: list[Any] = [
        ({"residual_flow": None}, "exactly one"),
        ({"flow": np.zeros((2, 3))}, "exactly one"),
        ({"T_ego1_ego0": None}, "pose_flow or T_ego1_ego0"),
        ({"residual_flow": np.zeros((3, 3))}, "residual_flow must have shape"),
        ({"eval_mask": np.zeros((2, 1), bool)}, "eval_mask must have shape"),
        ({"residual_axes": "ego"}, "residual_axes"),
        ({"T_ego1_ego0": np.eye(3)}, "T_ego1_ego0 must have shape"),
    ]
    for change, message in bad:
        with pytest.raises(CFlowError, match=message):
            EvalFrame(**{**parts, **change})
    only_pose_flow = EvalFrame(**{**parts, "T_ego1_ego0": None, "pose_flow": np.zeros((2, 3))})
    assert counts(scores(OSF, only_pose_flow)) == {25: 2}
    with pytest.raises(CFlowError, match="pass T_ego1_ego0"):
        scores(BSFE, only_pose_flow)


@pytest.mark.parametrize("definition", NAMES)
@settings(max_examples=8, deadline=None)
@given(order=st.permutations(range(5)), cut=st.integers(0, 5))
def test_order_and_merging_do_not_matter(definition: str, order: list[int], cut: int) -> None:
    frames = random_frames(5, size=60)
    first, second = SceneFlowMetrics(definition), SceneFlowMetrics(definition)
    for position, index in enumerate(order):
        (first if position < cut else second).update(frames[index])
    first.merge(second)
    assert flat(first.compute()) == close_to(scores(definition, *frames))
    assert json.loads(json.dumps(first.compute()))["num_frames"] == 5, "plain numbers"


def test_only_scores_of_one_definition_can_be_merged() -> None:
    for other in (replace(DEFINITIONS[OSF], max_range=50.0), AV2):
        with pytest.raises(CFlowError, match="cannot merge"):
            SceneFlowMetrics(OSF).merge(SceneFlowMetrics(other))


def cells(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]


def test_tables() -> None:
    text = format_table(scores(OSF, frame([[1, 0, 0], [0, 0, 0]], category=[CAR, 0])))
    assert "nan" not in text and len({len(line) for line in text.splitlines()[2:9]}) == 1  # columns line up
    rows = {row[0]: row[1:] for row in cells(text)}
    assert rows["CAR"] == ["-", "1.0000", "0", "1"] and rows["PEDESTRIAN"] == ["-", "-", "0", "0"]
    assert rows["0-35"] == ["0.0000", "1.0000", "1", "1"] and rows["0.3333"][:2] == ["1.0000", "0.0000"]
    item = frame([[1, 0, 0]] * 2, [[0, 0, 0], [0.5, 0, 0]], points=[[10, 0, 0], [50, 0, 0]])
    table = cells(format_table(scores("challenge_2026", item)))
    assert ["35-70", "0.5000", "-", "-", "-", "0.5000"] in table and ["**mean**", "", "", "", "", "0.7500"] in table


WHOLE = {"0-35": 0.25, "35-70": 0.5}


def test_figures_of_the_paper() -> None:
    """The score of a data set is the mean of its ranges (figure "performance_evolution_2x2", without nuScenes), the
    overall score the mean of data sets (figure "experiment_av2challenge_across_dataset", rounded in another order).
    """
    printed = {"AEVA": 0.4216, "AV2": 0.3587, "nuScenes": 0.6449, "TruckScenes": 0.45395, "Waymo": 0.34085}
    pairs = {
        "AEVA": (0.3603, 0.4829),
        "AV2": (0.2106, 0.5068),
        "TruckScenes": (0.3043, 0.6036),
        "Waymo": (0.2141, 0.4676),
    }
    ranges = {name: dict(zip(WHOLE, pair)) for name, pair in pairs.items()}
    for name, value in score_data_sets(ranges).data_sets.items():
        assert value == pytest.approx(printed[name], abs=1e-9), name
    whole = score_data_sets({name: {"0-70": value} for name, value in printed.items()}, list(printed))
    assert whole.overall == pytest.approx(0.444, abs=5e-5, rel=0)


@pytest.mark.parametrize(
    ("results", "reason", "holes"),
    [
        ({"A": WHOLE}, "data set B, range 0-35: no result", 2),
        ({"A": WHOLE, "B": {"0-35": 0.25}}, "data set B, range 35-70: no result", 1),
        ({"A": WHOLE, "B": {"0-35": 0.25, "35-70": None}}, "no dynamic points", 1),
    ],
)
def test_a_missing_result_makes_its_means_nan(results: dict[str, Any], reason: str, holes: int) -> None:
    combined = score_data_sets(results, ("A", "B"), list(WHOLE))
    assert len(combined.missing) == holes and reason in combined.missing[0]
    assert combined.data_sets["A"] == 0.375
    assert all(math.isnan(mean) for mean in (combined.data_sets["B"], combined.overall, combined.ranges["35-70"]))


def test_data_sets_and_ranges_that_are_not_required_are_an_error() -> None:
    for results, required, message in (
        ({"A": WHOLE, "B": WHOLE}, {"data_sets": ("A",)}, r"\['B'\] given"),
        ({"A": WHOLE}, {"ranges": ("0-35",)}, r"\['35-70'\] given"),
        ({}, {}, "nothing to combine"),
    ):
        with pytest.raises(CFlowError, match=message):
            score_data_sets(results, **required)


def test_overall_score_from_frames() -> None:
    """One car point at 10 m is missed, one at 50 m has half of its motion, one at 90 m is in no range."""
    points = [[10, 0, 0], [0, 50, 0], [90, 0, 0]]
    results = scores("challenge_2026", frame([[1, 0, 0]] * 3, [[0, 0, 0], [0.5, 0, 0], [1, 0, 0]], points=points))
    errors = errors_by_range(results)
    assert errors == {"0-35": 1.0, "35-70": 0.5}
    combined = score_data_sets({"A": errors})
    assert (combined.overall, combined.ranges, combined.missing) == (0.75, errors, ())
    assert results["bucketed_by_range"]["mean"]["dynamic_error"] == 0.75
    with pytest.raises(CFlowError, match="challenge_2026"):
        errors_by_range({"bucketed": {}})


def test_the_moving_iou_counts_ground_and_points_of_unknown_flow() -> None:
    true = [[0.0, 0, 0], [0.05, 0, 0], [0.0, 0, 0], [0.0, 0, 0], [1.0, 0, 0], [0.049, 0, 0]]
    parts: dict[str, Any] = {
        "residual_flow": np.array([[0.2, 0, 0], [0.05, 0, 0], [0.3, 0, 0], [1.0, 0, 0], [0.0, 0, 0], [0.0, 0, 0]]),
        "is_ground": [True, False, False, False, False, False],
        "is_valid": [True, True, False, False, True, True],
        "points": np.full((6, 3), 200.0),
    }
    by_flow = scores("mos", frame(true, **parts))["moving"]
    assert by_flow == {
        "iou": 1 / 3,  # point 1; point 0 is ground and predicted to move, point 4 is missed
        "precision": 1 / 2,
        "recall": 1 / 2,
        "num_moving": 2,
        "num_predicted": 2,
        "num_points": 4,
    }
    moving = [False, False, True, False, False, False]
    by_class = scores("mos", frame(true, **parts, moving=moving))["moving"]
    assert (by_class["num_points"], by_class["num_moving"], by_class["iou"]) == (5, 3, 2 / 4)
    assert scores(OSF, frame(true, **parts, moving=moving))["num_points"] == 3, "other definitions need flow"
    likely = [False, True, False, False, True, False]
    by_chance = frame(true, **parts, predicted_moving=likely)
    assert scores("mos", by_chance)["moving"]["iou"] == 1.0, "what the method itself says"
    assert str(scores(OSF, by_chance)) == str(scores(OSF, frame(true, **parts))), "flow alone decides elsewhere"
    nothing = scores("mos", frame(np.zeros((2, 3))))
    assert math.isnan(nothing["moving"]["iou"]) and "| -" in format_table(nothing)
    assert "moving IoU nan" in summary(nothing, {"median": 1.0}) and math.isnan(objective(nothing))
    both = SceneFlowMetrics("mos")
    both.update(frame(true, **parts))
    other = SceneFlowMetrics("mos")
    other.update(frame(true, **parts, moving=moving))
    both.merge(other)
    results = json.loads(json.dumps(both.compute()))
    assert results["moving"]["iou"] == 3 / 7 and objective(results) == 1 - 3 / 7
