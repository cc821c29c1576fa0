"""Our scores compared with those of the public evaluators: stored ones of a real pair, live ones of made-up frames.

The stored numbers were measured with av2 0.3.6 and OpenSceneFlow 848bf86. "npz" is the ego motion that the test log
stores in float32 (0.8 mm off the float64 poses, which moves 23 points across a bucket edge). The live comparison is
skipped where av2 or bucketed-scene-flow-eval 2.0.25 is not installed; docs/evaluation.md has the commands. It compares
every number that an evaluator returns. Both sides get the same truth, mask or ground, and ego motion T, so that they
can differ by arithmetic only.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Sequence

import numpy as np
import public_evaluators as public
import pytest
from public_evaluators import LOG, Comparison, check, score
from scenes import pose

from cflow_torch.data.av2 import AV2Log
from cflow_torch.evaluation import DEFINITIONS, EvalFrame
from cflow_torch.evaluation.frame import ego_motion_flow

CLASSES = ("BACKGROUND", "CAR", "PEDESTRIAN", "WHEELED_VRU", "OTHER_VEHICLES", "mean")
NAN = float("nan")
STATIC = [NAN, 1.0, 1.0, NAN, NAN, 1.0]  # dynamic errors of a residual of 0; no cyclist or other vehicle is dynamic


@pytest.fixture(scope="module")
def pair(av2_folder: Path) -> public.Pair:
    return public.read_pair(av2_folder)


def scores(pair: public.Pair, definition: Any, **parts: Any) -> dict[str, Any]:
    """Scores of a residual flow of 0, unless `parts` has another prediction."""
    defaults: dict[str, Any] = {
        "labels": pair.labels,
        "T_ego1_ego0": pair.T_float32,
        "is_ground": pair.is_ground,
        "eval_mask": public.official_mask(pair),
        "residual_flow": np.zeros_like(pair.points),
    }
    return score(definition, [EvalFrame(pair.points, **{**defaults, **parts})])


def check_three_way(results: dict[str, Any], **expected: float) -> None:
    measured = {key: results["three_way"][key] for key in expected}
    assert measured == pytest.approx(expected, abs=public.TOLERANCE, rel=0)


def check_classes(results: dict[str, Any], static: Sequence[float], dynamic: Sequence[float]) -> None:
    """Compare the static error in metres and the dynamic error of `CLASSES`."""
    rows = {**results["bucketed"]["classes"], "mean": results["bucketed"]["mean"]}
    for key, expected in (("static_epe", static), ("dynamic_error", dynamic)):
        found = [rows[name][key] for name in CLASSES]
        assert found == pytest.approx(expected, abs=public.TOLERANCE, rel=0, nan_ok=True), key


def filled(results: dict[str, Any], name: str, key: str) -> dict[int, Any]:
    """Bucket number -> value, of the buckets that have points."""
    buckets = results["bucketed"]["classes"][name]["buckets"]
    return {i: value for i, (value, count) in enumerate(zip(buckets[key], buckets["count"])) if count}


def test_av2_three_way(pair: public.Pair) -> None:
    # The official prediction is, bit for bit, the flow by ego motion that the labels store for the background.
    background = (pair.labels.category == 0)[:, None]
    pose_flow = np.where(background, pair.labels.flow, ego_motion_flow(pair.points, pair.T_float32))
    expected = {"epe_fd": 0.6737204147, "epe_fs": 0.0062440348, "epe_bs": 0.0, "epe_3way": 0.2266548165}
    check_three_way(scores(pair, "av2", pose_flow=pose_flow), **expected, dynamic_iou=0.0)


def test_opensceneflow_npz(pair: public.Pair) -> None:
    results = scores(pair, "opensceneflow")
    check_three_way(
        results, epe_fd=0.6737206772, epe_fs=0.0062896596, epe_bs=6.2128e-07, epe_3way=0.2266703194, dynamic_iou=0.0
    )
    check_classes(results, [6.21e-07, 0.00620734, 0.00582801, 0.00385737, NAN, 0.00397334], STATIC)
    assert filled(results, "CAR", "count") == {0: 6051, 1: 24, 3: 208, 11: 239, 20: 1117, 26: 161}
    speeds = {0: 0.0062073, 1: 0.0491397, 3: 0.1400945, 11: 0.4419174, 20: 0.8175343, 26: 1.0444958}
    assert filled(results, "CAR", "speed") == pytest.approx(speeds, abs=public.TOLERANCE, rel=0)
    assert filled(results, "PEDESTRIAN", "count") == {0: 156, 2: 94}
    assert filled(results, "PEDESTRIAN", "speed")[2] == pytest.approx(0.0998975, abs=public.TOLERANCE, rel=0)
    assert filled(results, "WHEELED_VRU", "count") == {0: 166}
    assert results["three_way"]["breakdown"]["foreground"]["dynamic"]["all"]["count"] == 1_819


def test_opensceneflow_range_wise(pair: public.Pair) -> None:
    ranges = scores(pair, "opensceneflow")["range_wise"]
    counts = {name: (row["num_static"], row["num_dynamic"]) for name, row in ranges.items() if name != "mean"}
    near = {"0-35": (71_046, 1_612), "35-50": (5_502, 0), "50-75": (346, 0)}
    assert counts == {**near, "75-100": (0, 0), "100-inf": (0, 0)}
    measured = [ranges[name]["static_epe"] for name in ("0-35", "35-50", "50-75", "mean")]
    expected = [0.00091971, 0.00036213, 1.825e-06, 0.00042789]
    assert measured == pytest.approx(expected, abs=1e-8, rel=0)  # every digit that was printed
    assert ranges["0-35"]["dynamic_epe"] == pytest.approx(0.74473900, abs=public.TOLERANCE, rel=0)


def test_noise(pair: public.Pair) -> None:
    noise = np.random.default_rng(0).normal(0, 0.05, pair.points.shape).astype(np.float32)
    results = scores(pair, "opensceneflow", residual_flow=noise)
    check_three_way(results, epe_fd=0.6799331272, epe_fs=0.0798506559, epe_bs=0.0799001127, dynamic_iou=0.0247696440)
    static = [0.0799001127, 0.0797635345, 0.0811704863, 0.0797579710, NAN, 0.0801480261]
    check_classes(results, static, [NAN, 1.1924512872, 1.3127384422, NAN, NAN, 1.2525948647])


def is_long(flow: np.ndarray) -> np.ndarray:
    return np.linalg.norm(flow, axis=1) >= np.float32(0.05)


METRIC_KEYS = {
    "EPE": "epe",
    "Accuracy Strict": "accuracy_strict",
    "Accuracy Relax": "accuracy_relax",
    "Angle Error": "angle_error",
}


def compare_av2(ours: dict[str, Any], table: Any, totals: dict[str, float]) -> Comparison:
    """Every number of `evaluate_directories` (counts, hits and misses per subset) and of `results_to_dict`."""
    whole = {"Dynamic IoU": "dynamic_iou", "EPE 3-Way Average": "epe_3way"}
    numbers: Comparison = {name: (ours[whole[name]], totals[name]) for name in whole}
    for (name, motion, distance), rows in table.groupby(["Class", "Motion", "Distance"]):
        cell = ours["breakdown"][name.lower()][motion.lower()][distance.lower()]
        hit, miss = cell["num_predicted"], cell["count"] - cell["num_predicted"]
        expected = (hit, 0, 0, miss) if motion == "Dynamic" else (0, hit, miss, 0)
        for key, value in zip(("Count", "TP", "FP", "TN", "FN"), (cell["count"], *expected)):
            numbers[f"{key}/{name}/{motion}/{distance}"] = value, rows[key].sum()
    for name in set(totals) - set(whole):
        metric, group, motion, *distance = name.split("/")
        cells = ours["breakdown"][group.lower()][motion.lower()]
        numbers[name] = cells[distance[0].lower() if distance else "all"][METRIC_KEYS[metric]], totals[name]
    sets = {"epe_fd": "Foreground/Dynamic", "epe_fs": "Foreground/Static", "epe_bs": "Background/Static"}
    return {**numbers, **{key: (ours[key], totals[f"EPE/{name}"]) for key, name in sets.items()}}


def run_av2(av2: Any, truths: Sequence[dict[str, Any]], predictions: Sequence[dict[str, Any]]) -> Any:
    """Write the files of the challenge with av2's own writers and evaluate them: per-frame table, totals."""
    with tempfile.TemporaryDirectory() as root:
        folders = Path(root) / "truth", Path(root) / "prediction"
        for folder in folders:
            folder.mkdir()
        for number, (truth, prediction) in enumerate(zip(truths, predictions)):
            sweep = {"sweep_uuid": (LOG, public.TIME + number)}
            av2.make_annotation_files.write_annotation(**truth, **sweep, output_dir=folders[0])
            av2.utils.write_output_file(**prediction, **sweep, output_dir=folders[1])
        table = av2.eval.evaluate_directories(*folders)
    return table, av2.eval.results_to_dict(table)


KINDS = ("edges", "random", "nothing valid", "all ground", "only static", "moving background", "no points", "random")


def made_up(kind: str, seed: int) -> public.MadeUp:
    """Make a frame of one kind of corner case.

    "edges" has no ego motion, so that values lie exactly on limits. It is the first frame of a log, where both poses
    are the identity, because the product of two other equal poses is not exactly the identity.
    """
    rng = np.random.default_rng(seed)
    n = 0 if kind == "no points" else int(rng.integers(50, 250))
    points = (rng.uniform(-55, 55, (n, 3)) * [1, 1, 0.06]).astype(np.float32)
    true = rng.normal(0, 0.6, (n, 3)) * rng.choice([0, 0.02, 1, 4], (n, 1))
    category = rng.choice([0, 0, 4, 14, 17, 19, 19, 19, 21, 25, *range(31)], n)
    true[(category == 0) & (kind != "moving background")] = 0
    T = np.eye(4)
    if kind == "edges":
        directions = np.array([[1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [0.48, 0.64, -0.6]])
        true = rng.choice([*public.EDGES, 0.05, 2.5], (n, 1)) * directions[rng.integers(0, 4, n)]
        points[:, :2] = rng.choice([-48, -35, -34.99999, 0, 34.99999, 35, 35.00001, 47.9999, 48, 50, 51], (n, 2))
        points[:, 2] = rng.choice([-2.5, -2.49, 0, 2.49, 2.5], n)
    else:
        true *= 0.001 if kind == "only static" else 1
        angle, x = rng.uniform(-0.05, 0.05), rng.uniform(-3, 0)
        T = pose(x, 0.1, angle, 0.01)
        # Total flow in float32 has errors of 1e-7 m, so speeds keep a distance from the limits.
        speed = np.linalg.norm(true, axis=1, keepdims=True)
        near = np.abs(speed - np.append(public.EDGES[1:], 0.05)).min(axis=1, keepdims=True) < 1e-5
        true = np.where(near, true * 1.001, true)
    return public.MadeUp(
        points=points,
        true=true.astype(np.float32),
        predicted=(true * rng.choice([0, 0.5, 1], (n, 1)) + rng.normal(0, 0.03, (n, 3))).astype(np.float32),
        category=category.astype(np.uint8),
        is_valid=np.zeros(n, dtype=bool) if kind == "nothing valid" else rng.random(n) < 0.9,
        is_ground=np.ones(n, dtype=bool) if kind == "all ground" else rng.random(n) < 0.2,
        T=T,
    )


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_av2_on_made_up_frames(av2_tools: ModuleType, seed: int) -> None:
    truths, predicted, frames = [], [], []
    for number, kind in enumerate(KINDS):
        made = made_up(kind, 100 * seed + number)
        mask = ~made.is_ground & (np.abs(made.points[:, :2]) <= 50).all(axis=1)
        pose_flow, labels = ego_motion_flow(made.points, made.T), made.labels
        total = public.total_flow(made.points, made.predicted, made.T)
        columns = {"category_indices": labels.category, "is_valid": labels.is_valid, "flow": labels.flow}
        columns["is_close"] = (np.abs(made.points[:, :2]) <= 35).all(axis=1)
        columns["is_dynamic"] = is_long(labels.flow - pose_flow)
        truths.append({name: values[mask] for name, values in columns.items()})
        predicted.append({"flow": total[mask], "is_dynamic": is_long(total - pose_flow)[mask]})
        frames.append(EvalFrame(made.points, labels, flow=total, T_ego1_ego0=made.T, is_ground=made.is_ground))
    numbers = compare_av2(score("av2", frames)["three_way"], *run_av2(av2_tools, truths, predicted))
    check(f"av2, made up {seed}", numbers)


def run_bsfe(data_set: Any, predictions: Sequence[np.ndarray]) -> Any:
    from bucketed_scene_flow_eval.datastructures import EgoLidarFlow

    assert len(data_set) == len(predictions)
    evaluator = data_set.evaluator()
    for number, flow in enumerate(predictions):
        evaluator.eval(EgoLidarFlow(full_flow=flow, mask=np.ones(len(flow), dtype=bool)), data_set[number][0])
    return evaluator


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_bsfe_on_made_up_frames(bsfe: ModuleType, tmp_path: Path, seed: int) -> None:
    """Both metrics, inside 35 m and in the whole crop, without and with ground."""
    kinds = [kind for kind in KINDS if kind not in ("no points", "all ground")]
    made = [made_up(kind, 100 * seed + number) for number, kind in enumerate(kinds)]
    raw = public.write_log(tmp_path / "raw", made)
    labels = [(frame.true, frame.category, frame.is_valid) for frame in made]
    truth = public.write_bsfe_truth(tmp_path / "truth", labels)
    log, frames = AV2Log(raw / LOG, ground="bsfe"), []
    for number, frame in enumerate(made):
        sweep = log.sweep(number)
        np.testing.assert_allclose(np.linalg.inv(log.sweep(number + 1).pose) @ sweep.pose, frame.T, atol=1e-9)
        assert 0 < sweep.is_ground.sum() < len(sweep.is_ground)
        parts = {"residual_flow": frame.predicted, "residual_axes": "t", "T_ego1_ego0": frame.T}
        frames.append(EvalFrame(sweep.points, frame.labels, is_ground=sweep.is_ground, **parts))
    predictions, definition = [frame.predicted for frame in made], DEFINITIONS["bucketed_scene_flow_eval"]
    for ground in (False, True):
        output = tmp_path / f"ground {ground}"
        output.mkdir()
        kinds = ("bucketed_epe", "threeway_epe")
        data_sets = [public.bsfe_data_set(bsfe, raw, truth, kind, output, ground) for kind in kinds]
        buckets, three_way = (run_bsfe(data_set, predictions) for data_set in data_sets)
        scored = [replace(frame, is_ground=None) for frame in frames] if ground else frames
        for distance in (35, math.inf):
            ours = score(replace(definition, max_range=distance), scored)
            where = f"made up {seed}, {distance} m, ground {ground}"
            check(f"bsfe buckets, {where}", public.bucket_numbers(ours["bucketed"], buckets, output, distance))
            found = three_way.compute_results(return_distance_threshold=distance)
            check(f"bsfe three-way, {where}", public.three_way_numbers(ours["three_way"], found))
