"""Our scores against the public evaluators themselves: av2 0.3.6 and bucketed-scene-flow-eval 2.0.25.

Skipped where these packages are not installed; docs/evaluation.md says how to install them. Every number that an
evaluator gives has a counterpart here. Where the two sides could differ for another reason than arithmetic, both get
the same: truth, evaluation mask or ground, ego motion T.
"""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Dict, List, Optional, Sequence, Tuple

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather
import pytest
import torch
from conftest import WHY_SKIPPED

from cflow_torch import CorrelationFlow
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.ground import read_ground_raster
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.evaluation import DEFINITIONS, EvalFrame, SceneFlowMetrics
from cflow_torch.data.categories import CATEGORIES, META_CLASSES
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.types import CFlowError

TOLERANCE = 1e-6
PREDICTIONS = ("zero", "half", "noise", "paper")
LOG, TIME = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede", 315966265259836000
FLOW = ("flow_tx_m", "flow_ty_m", "flow_tz_m")


@pytest.fixture(scope="module")
def av2_eval() -> ModuleType:
    """av2.evaluation.scene_flow.eval."""
    return pytest.importorskip("av2.evaluation.scene_flow.eval", reason=WHY_SKIPPED)


class Comparison:
    """Pairs (ours, theirs) under a name; `check` asserts that none differs by more than the tolerance."""

    def __init__(self) -> None:
        self.differences: Dict[str, float] = {}

    def add(self, name: str, ours: Any, theirs: Any) -> None:
        both_nan = math.isnan(ours) and math.isnan(theirs)
        difference = 0.0 if both_nan else abs(float(ours) - float(theirs))
        assert name not in self.differences, name
        self.differences[name] = math.inf if math.isnan(difference) else difference

    def check(self, label: str) -> None:
        name = max(self.differences, key=lambda key: self.differences[key])
        print(f"\n{label}: {len(self.differences)} numbers, largest difference {self.differences[name]:.2e} ({name})")
        too_far = {key: value for key, value in self.differences.items() if value > TOLERANCE}
        assert not too_far


def score(definition: Any, frames: Sequence[EvalFrame]) -> Dict[str, Any]:
    metrics = SceneFlowMetrics(definition)
    for frame in frames:
        metrics.update(frame)
    return metrics.compute()


# ---------------------------------------------------------------------------------------------- the real pair


@dataclass(frozen=True)
class Pair:
    """The real pair with its official labels, and four predictions as residuals in the axes of t+1."""

    folder: Path
    points: np.ndarray
    labels: FlowLabels
    is_dynamic: np.ndarray  # as the label file says
    T_float32: np.ndarray  # of the label file; what av2's loader computes too
    T_float64: np.ndarray  # from the poses
    residuals: Dict[str, np.ndarray]


@pytest.fixture(scope="module")
def pair(av2_folder: Path) -> Pair:
    log = AV2Log(av2_folder)
    sweeps, labels = window(log, 0), log.labels(0)
    assert labels is not None
    points = sweeps.pc0.points
    T = np.load(av2_folder / "ego_motion.npz")["ego_motion"][0].astype(np.float64)
    noise = np.random.default_rng(0).normal(0, 0.05, points.shape).astype(np.float32)
    return Pair(
        folder=av2_folder,
        points=points,
        labels=labels,
        is_dynamic=feather.read_table(str(av2_folder / "flow_labels.feather"))["dynamic"].to_numpy(),
        T_float32=T,
        T_float64=np.linalg.inv(sweeps.pc1.pose) @ sweeps.pc0.pose,
        residuals={
            "zero": np.zeros_like(points),
            "half": 0.5 * (labels.flow - ego_motion_flow(points, T)),
            "noise": noise,
            "paper": CorrelationFlow.from_preset("paper")([sweeps])[0].residual_flow.numpy(),
        },
    )


# ---------------------------------------------------------------------------------------------- av2

METRIC_KEYS = {
    "EPE": "epe",
    "Accuracy Strict": "accuracy_strict",
    "Accuracy Relax": "accuracy_relax",
    "Angle Error": "angle_error",
}


def compare_av2(ours: Dict[str, Any], table: Any, totals: Dict[str, float]) -> Comparison:
    """Every number of `evaluate_directories` (counts, hits and misses per subset) and of `results_to_dict`."""
    comparison = Comparison()
    for (name, motion, distance), rows in table.groupby(["Class", "Motion", "Distance"]):
        cell = ours["breakdown"][name.lower()][motion.lower()][distance.lower()]
        hit, miss = cell["num_predicted"], cell["count"] - cell["num_predicted"]
        expected = (hit, 0, 0, miss) if motion == "Dynamic" else (0, hit, miss, 0)
        place = f"{name}/{motion}/{distance}"
        comparison.add(f"Count/{place}", cell["count"], rows.Count.sum())
        for key, value in zip(("TP", "FP", "TN", "FN"), expected):
            comparison.add(f"{key}/{place}", value, rows[key].sum())
    for name, value in totals.items():
        if name == "Dynamic IoU":
            comparison.add(name, ours["dynamic_iou"], value)
        elif name == "EPE 3-Way Average":
            comparison.add(name, ours["epe_3way"], value)
        else:
            metric, group, motion, *distance = name.split("/")
            cells = ours["breakdown"][group.lower()][motion.lower()]
            comparison.add(name, cells[distance[0].lower() if distance else "all"][METRIC_KEYS[metric]], value)
    comparison.add("EPE FD", ours["epe_fd"], totals["EPE/Foreground/Dynamic"])
    comparison.add("EPE FS", ours["epe_fs"], totals["EPE/Foreground/Static"])
    comparison.add("EPE BS", ours["epe_bs"], totals["EPE/Background/Static"])
    return comparison


def run_av2(av2_eval: ModuleType, truths: Sequence[Dict[str, Any]], predictions: Sequence[Dict[str, Any]]) -> Any:
    """Write the files of the challenge with av2's own writers and evaluate them: per-frame table, totals."""
    from av2.evaluation.scene_flow.make_annotation_files import write_annotation
    from av2.evaluation.scene_flow.utils import write_output_file

    with tempfile.TemporaryDirectory() as root:
        folders = Path(root) / "truth", Path(root) / "prediction"
        for folder in folders:
            folder.mkdir()
        for number, (truth, prediction) in enumerate(zip(truths, predictions)):
            write_annotation(**truth, sweep_uuid=(LOG, TIME + number), output_dir=folders[0])
            write_output_file(**prediction, sweep_uuid=(LOG, TIME + number), output_dir=folders[1])
        table = av2_eval.evaluate_directories(*folders)
    return table, av2_eval.results_to_dict(table)


@pytest.fixture(scope="module")
def av2_mask(av2_eval: ModuleType, pair: Pair, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Points that the challenge scores, from av2's own mask file of the log."""
    from av2.evaluation.scene_flow.make_mask_files import make_mask_files
    from av2.evaluation.scene_flow.utils import get_eval_point_mask

    root = tmp_path_factory.mktemp("av2")
    (root / "av2" / "sensor").mkdir(parents=True)
    (root / "av2" / "sensor" / "val").symlink_to(pair.folder.parent)
    make_mask_files(str(root / "masks.zip"), str(root), "av2", "val")
    return get_eval_point_mask((LOG, TIME), root / "masks.zip").numpy()


def truth_for_av2(pair: Pair, mask: np.ndarray) -> Dict[str, Any]:
    return {
        "category_indices": pair.labels.category[mask],
        "is_close": (np.abs(pair.points[mask, :2]) <= 35).all(axis=1),
        "is_dynamic": pair.is_dynamic[mask],
        "is_valid": pair.labels.is_valid[mask],
        "flow": pair.labels.flow[mask],
    }


@pytest.mark.parametrize("name", PREDICTIONS)
@pytest.mark.parametrize("ego_motion", ["T_float32", "T_float64"])
def test_av2_on_the_real_pair(
    av2_eval: ModuleType, pair: Pair, av2_mask: np.ndarray, name: str, ego_motion: str
) -> None:
    T = getattr(pair, ego_motion)
    pose_flow = ego_motion_flow(pair.points, T)
    total = pose_flow + pair.residuals[name]
    is_dynamic = np.linalg.norm(total - pose_flow, axis=1) >= 0.05
    prediction = {"flow": total[av2_mask], "is_dynamic": is_dynamic[av2_mask]}
    table, totals = run_av2(av2_eval, [truth_for_av2(pair, av2_mask)], [prediction])
    frame = EvalFrame(pair.points, pair.labels, flow=total, T_ego1_ego0=T, eval_mask=av2_mask)
    comparison = compare_av2(score("av2", [frame])["three_way"], table, totals)
    comparison.check(f"av2, {name}, {ego_motion}")
    assert len(comparison.differences) == 8 * 5 + 4 * 9 + 2 + 3


def test_av2_truth_from_its_own_recipe(av2_eval: ModuleType, pair: Pair, av2_mask: np.ndarray) -> None:
    """av2's loader makes the truth from the boxes: up to 1e-5 m off the label file, which float16 may round apart."""
    from av2.torch.data_loaders.scene_flow import SceneFlowDataloader

    with tempfile.TemporaryDirectory() as root:
        (Path(root) / "av2" / "sensor").mkdir(parents=True)
        (Path(root) / "av2" / "sensor" / "val").symlink_to(pair.folder.parent)
        _, _, ego_motion, truth = SceneFlowDataloader(Path(root), "av2", "val")[0]
    np.testing.assert_array_equal(ego_motion.matrix().numpy().reshape(4, 4), pair.T_float32.astype(np.float32))
    labels = FlowLabels(truth.flow.numpy(), truth.category_indices.numpy(), truth.is_valid.numpy())
    assert 0 < np.abs(labels.flow - pair.labels.flow).max() < 1e-5
    assert (labels.category == pair.labels.category).all() and (truth.is_dynamic.numpy() == pair.is_dynamic).all()
    live = replace(pair, labels=labels)
    total = ego_motion_flow(pair.points, pair.T_float32) + pair.residuals["paper"]
    is_dynamic = np.linalg.norm(pair.residuals["paper"], axis=1) >= 0.05
    prediction = {"flow": total[av2_mask], "is_dynamic": is_dynamic[av2_mask]}
    table, totals = run_av2(av2_eval, [truth_for_av2(live, av2_mask)], [prediction])
    frame = EvalFrame(
        pair.points, labels, flow=total, T_ego1_ego0=pair.T_float32, eval_mask=av2_mask, is_dynamic=is_dynamic
    )
    compare_av2(score("av2", [frame])["three_way"], table, totals).check("av2, its own truth")


def test_av2_mask_and_ours_differ_in_one_point(pair: Pair, av2_mask: np.ndarray) -> None:
    """Cause: av2 computes city coordinates (kilometres) in float32, whose step of 0.5 mm puts one point into the next
    cell of the ground raster. We compute them in float64."""
    log = AV2Log(pair.folder)
    sweep, raster = log.sweep(0), read_ground_raster(pair.folder / "map")
    ours = ~sweep.is_ground & (np.abs(pair.points[:, :2]) <= 50).all(axis=1)
    (different,) = np.flatnonzero(ours != av2_mask)
    city = pair.points[different].astype(np.float64) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
    assert raster is not None
    assert raster.is_ground(np.stack([city, city + [5e-4, 0, 0]])).tolist() == [False, True]


# ---------------------------------------------------------------------------------------------- made-up frames

EDGES = np.linspace(0, 2, 51)
KINDS = ("edges", "random", "nothing valid", "all ground", "only static", "moving background", "no points", "random")


@dataclass(frozen=True)
class MadeUp:
    """A frame in the frames of bucketed-scene-flow-eval: residuals in the axes of t."""

    points: np.ndarray
    true: np.ndarray
    predicted: np.ndarray
    category: np.ndarray
    is_valid: np.ndarray
    is_ground: np.ndarray
    T: np.ndarray


def made_up(kind: str, seed: int) -> MadeUp:
    """A frame of one kind of corner case.

    "edges" has no ego motion, so that limits are hit exactly. It comes first in a log, where both poses are the
    identity: the product of two other equal poses is not exactly the identity.
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
        true = rng.choice([*EDGES, 0.05, 2.5], (n, 1)) * directions[rng.integers(0, 4, n)]
        points[:, :2] = rng.choice([-48, -35, -34.99999, 0, 34.99999, 35, 35.00001, 47.9999, 48, 50, 51], (n, 2))
        points[:, 2] = rng.choice([-2.5, -2.49, 0, 2.49, 2.5], n)
    elif kind == "only static":
        true *= 0.001
    if kind != "edges":
        angle = rng.uniform(-0.05, 0.05)
        T[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        T[:3, 3] = [rng.uniform(-3, 0), 0.1, 0.01]
        # A total flow in float32 carries 1e-7 m, so keep clear of the limits that such an error would cross.
        speed = np.linalg.norm(true, axis=1, keepdims=True)
        near = np.abs(speed - np.append(EDGES[1:], 0.05)).min(axis=1, keepdims=True) < 1e-5
        true = np.where(near, true * 1.001, true)
    return MadeUp(
        points=points,
        true=true.astype(np.float32),
        predicted=(true * rng.choice([0, 0.5, 1], (n, 1)) + rng.normal(0, 0.03, (n, 3))).astype(np.float32),
        category=category.astype(np.uint8),
        is_valid=np.zeros(n, dtype=bool) if kind == "nothing valid" else rng.random(n) < 0.9,
        is_ground=np.ones(n, dtype=bool) if kind == "all ground" else rng.random(n) < 0.2,
        T=T,
    )


def total_flow(points: np.ndarray, residual: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Total flow of residuals in the axes of t: T (p + r) - p."""
    start = points.astype(np.float64)
    return ((start + residual) @ T[:3, :3].T + T[:3, 3] - start).astype(np.float32)


@pytest.mark.parametrize("seed", range(6))
def test_av2_on_made_up_frames(av2_eval: ModuleType, seed: int) -> None:
    truths, predictions, frames = [], [], []
    for number, kind in enumerate(KINDS):
        made = made_up(kind, 100 * seed + number)
        mask = ~made.is_ground & (np.abs(made.points[:, :2]) <= 50).all(axis=1)
        pose_flow = ego_motion_flow(made.points, made.T)
        true, predicted = (total_flow(made.points, flow, made.T) for flow in (made.true, made.predicted))
        lengths = [torch.linalg.vector_norm(torch.from_numpy(flow - pose_flow), dim=-1) for flow in (true, predicted)]
        truths.append(
            {
                "category_indices": made.category[mask],
                "is_close": np.logical_and.reduce(np.abs(made.points[mask, :2]) <= 35.0, axis=1),
                "is_dynamic": (lengths[0] >= 0.05).numpy()[mask],
                "is_valid": made.is_valid[mask],
                "flow": true[mask],
            }
        )
        predictions.append({"flow": predicted[mask], "is_dynamic": (lengths[1] >= 0.05).numpy()[mask]})
        labels = FlowLabels(true, made.category, made.is_valid)
        frames.append(EvalFrame(made.points, labels, flow=predicted, T_ego1_ego0=made.T, is_ground=made.is_ground))
    table, totals = run_av2(av2_eval, truths, predictions)
    compare_av2(score("av2", frames)["three_way"], table, totals).check(f"av2, made up {seed}")


def test_av2_by_class(av2_eval: ModuleType) -> None:
    """av2's per-frame function takes any grouping of categories: ours by meta class is the same."""
    from enum import Enum

    groups = Enum("groups", {name: name for name in META_CLASSES})  # type: ignore[misc]
    members = {group: [CATEGORIES.index(name) for name in META_CLASSES[group.value]] for group in groups}
    made = made_up("random", 5)
    true, predicted = (flow.astype(np.float16) for flow in (made.true, made.predicted))
    is_dynamic = np.linalg.norm(made.true, axis=1) >= 0.05
    is_close = (np.abs(made.points[:, :2]) <= 35).all(axis=1)
    columns = av2_eval.compute_metrics(
        predicted, is_dynamic, true, made.category, is_dynamic, is_close, made.is_valid, members
    )
    labels = FlowLabels(made.true, made.category, made.is_valid)
    everywhere = replace(DEFINITIONS["av2"], mask_box=None)
    frame = EvalFrame(made.points, labels, residual_flow=made.predicted, T_ego1_ego0=np.eye(4))
    ours = score(everywhere, [frame])["three_way"]["by_class"]
    comparison = Comparison()
    for row, name in enumerate(columns["Class"]):
        place = name, columns["Motion"][row], columns["Distance"][row]
        cell = ours[name][place[1].lower()][place[2].lower()]
        comparison.add(f"{place} count", cell["count"], columns["Count"][row])
        for metric, key in METRIC_KEYS.items():
            comparison.add(f"{place} {key}", cell[key], columns[metric.upper().replace(" ", "_")][row])
    assert sum(cell > 0 for cell in columns["Count"]) > 10
    comparison.check("av2, by class")


def test_av2_counts_nan_as_no_error(av2_eval: ModuleType) -> None:
    """A named difference: one NaN makes av2 count the error of its whole subset as 0. We refuse NaN."""
    true = np.array([[1, 0, 0]] * 2, dtype=np.float32)
    predicted = np.array([[np.nan, 0, 0], [0, 0, 0]], dtype=np.float32)
    yes, category = np.ones(2, dtype=bool), np.full(2, 19, dtype=np.uint8)
    truth = {"category_indices": category, "is_close": yes, "is_dynamic": yes, "is_valid": yes, "flow": true}
    _, totals = run_av2(av2_eval, [truth], [{"flow": predicted, "is_dynamic": yes}])
    assert totals["EPE/Foreground/Dynamic"] == 0.0
    frame = EvalFrame(np.ones((2, 3)), FlowLabels(true, category, yes), flow=predicted, T_ego1_ego0=np.eye(4))
    with pytest.raises(CFlowError, match="1 scored points have NaN"):
        score("av2", [frame])


# ---------------------------------------------------------------------------------------------- BucketedSceneFlowEval


def write_table(file: Path, **columns: np.ndarray) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), str(file))


def write_bsfe_truth(root: Path, truths: Sequence[Tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """Truth as the loader wants it: residual in the axes of t, valid rows, category one lower than Argoverse 2's."""
    for number, (residual, category, is_valid) in enumerate(truths):
        write_table(
            root / LOG / f"{number:010d}.feather",
            **dict(zip(FLOW, np.ascontiguousarray(residual.T))),
            is_valid=is_valid,
            classes_0=category.astype(np.int8) - np.int8(1),
        )


def write_log(root: Path, made: Sequence[MadeUp]) -> None:
    """Raw log of made-up frames: flat ground at height 0 whose points are lowered to it, poses that chain the T."""
    folder, pose = root / LOG, np.eye(4)
    rows: List[List[float]] = []
    for number, frame in enumerate([*made, made[0]]):  # one more sweep, for the last pair
        write_table(
            folder / "sensors" / "lidar" / f"{TIME + number}.feather", **dict(zip("xyz", frame.points.T.copy()))
        )
        half_yaw = math.atan2(pose[1, 0], pose[0, 0]) / 2
        rows.append([math.cos(half_yaw), 0, 0, math.sin(half_yaw), *pose[:3, 3]])
        pose = pose @ np.linalg.inv(frame.T)
    names = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    times = TIME + np.arange(len(rows))
    write_table(folder / "city_SE3_egovehicle.feather", timestamp_ns=times, **dict(zip(names, np.array(rows).T.copy())))
    (folder / "map").mkdir()
    heights = np.random.default_rng(0).choice([-9.0, -9.0, -9.0, 9.0, np.nan], (400, 400)).astype(np.float16)
    np.save(folder / "map" / f"{LOG}_ground_height_surface____MADE.npy", heights)
    alignment = {"R": [1.0, 0.0, 0.0, 1.0], "t": [100.0, 100.0], "s": 2.0}
    (folder / "map" / f"{LOG}___img_Sim2_city.json").write_text(json.dumps(alignment))


def run_bsfe(
    bsfe: ModuleType,
    kind: str,
    raw: Path,
    truth: Path,
    predictions: Sequence[np.ndarray],
    distance: float = 35,
    with_ground: bool = False,
) -> Tuple[Dict[str, Any], Dict[Any, Any], List[float]]:
    """Scores per class, per raw category and bucket, and the mean over classes."""
    from bucketed_scene_flow_eval.datastructures import EgoLidarFlow
    from bucketed_scene_flow_eval.eval.base_per_frame_sceneflow_eval import PerFrameSceneFlowEvaluator

    with tempfile.TemporaryDirectory() as output:
        data_set = bsfe.Argoverse2CausalSceneFlow(
            raw,
            flow_data_path=truth,
            with_ground=with_ground,
            use_gt_flow=True,
            eval_type=kind,
            eval_args={"output_path": Path(output)},
            cache_root=Path(output),
            use_cache=False,
        )
        assert len(data_set) == len(predictions)
        evaluator = data_set.evaluator()
        for number, flow in enumerate(predictions):
            frame = data_set[number][0]
            evaluator.eval(EgoLidarFlow(full_flow=flow, mask=np.ones(len(flow), dtype=bool)), frame)
        classes = evaluator.compute_results(return_distance_threshold=distance)
        cells = PerFrameSceneFlowEvaluator.compute_results(evaluator, save_results=False)
        mean = json.loads((Path(output) / f"mean_average_results_{distance}.json").read_text())
    return classes, cells, mean


def compare_buckets(ours: Dict[str, Any], result: Any, distance: float) -> Comparison:
    """Per class, the mean over classes, and per bucket: points, mean error, mean speed."""
    classes, cells, mean = result
    comparison = Comparison()
    for name, (static, dynamic) in classes.items():
        comparison.add(f"{name} static", ours["classes"][name]["static_epe"], static)
        comparison.add(f"{name} dynamic", ours["classes"][name]["dynamic_error"], dynamic)
        buckets = ours["classes"][name]["buckets"]
        for number, edges in enumerate(zip(EDGES, [*EDGES[1:], math.inf])):
            members = "BACKGROUND" if name == "BACKGROUND" else META_CLASSES[name]
            found = [
                value
                for key, value in cells.items()
                if key.name in members and key.distance_threshold == distance and key.speed_thresholds == edges
            ]
            count = sum(cell.count for cell in found)
            comparison.add(f"{name} {number} count", buckets["count"][number], count)
            if count:
                error, speed = (
                    sum(getattr(cell, what) * cell.count for cell in found) / count for what in ("avg_epe", "avg_speed")
                )
                comparison.add(f"{name} {number} EPE", buckets["epe"][number], error)
                comparison.add(f"{name} {number} speed", buckets["speed"][number], speed)
    comparison.add("mean static", ours["mean"]["static_epe"], mean[0])
    comparison.add("mean dynamic", ours["mean"]["dynamic_error"], mean[1])
    return comparison


def compare_three_way(ours: Dict[str, Any], classes: Dict[str, Any]) -> Comparison:
    comparison = Comparison()
    for name, (static, dynamic) in classes.items():
        cells = ours["breakdown"][name.lower()]
        comparison.add(f"{name} static", cells["static"]["all"]["epe"], static)
        comparison.add(f"{name} dynamic", cells["dynamic"]["all"]["epe"], dynamic)
    assert set(classes) == {"BACKGROUND", "FOREGROUND"}
    comparison.add("FD", ours["epe_fd"], classes["FOREGROUND"][1])
    comparison.add("FS", ours["epe_fs"], classes["FOREGROUND"][0])
    comparison.add("BS", ours["epe_bs"], classes["BACKGROUND"][0])
    return comparison


def check_bsfe(
    bsfe: ModuleType, label: str, raw: Path, truth: Path, predictions: Sequence[np.ndarray], frames: Sequence[EvalFrame]
) -> None:
    """Both metrics, inside 35 m and in the whole crop, without and with ground."""
    for with_ground in (False, True):
        for distance, region in ((35, "box"), (math.inf, "all")):
            ours = score(
                replace(DEFINITIONS["bucketed_scene_flow_eval"], region=region, exclude_ground=not with_ground), frames
            )
            where = f"{label}, {distance} m" + (", with ground" if with_ground else "")
            result = run_bsfe(bsfe, "bucketed_epe", raw, truth, predictions, distance, with_ground)
            compare_buckets(ours["bucketed"], result, distance).check(f"bsfe buckets, {where}")
            result = run_bsfe(bsfe, "threeway_epe", raw, truth, predictions, distance, with_ground)
            compare_three_way(ours["three_way"], result[0]).check(f"bsfe three-way, {where}")


@pytest.mark.parametrize("name", PREDICTIONS)
def test_bsfe_on_the_real_pair(bsfe: ModuleType, pair: Pair, tmp_path: Path, name: str) -> None:
    T, start = pair.T_float64, pair.points.astype(np.float64)
    end_at_t = (start + pair.labels.flow - T[:3, 3]) @ T[:3, :3]
    write_bsfe_truth(tmp_path, [((end_at_t - start).astype(np.float32), pair.labels.category, pair.labels.is_valid)])
    residual_at_t = (pair.residuals[name].astype(np.float64) @ T[:3, :3]).astype(np.float32)
    frame = EvalFrame(
        pair.points,
        pair.labels,
        residual_flow=pair.residuals[name],
        T_ego1_ego0=T,
        is_ground=AV2Log(pair.folder, ground="bsfe").sweep(0).is_ground,
    )
    check_bsfe(bsfe, name, pair.folder.parent, tmp_path, [residual_at_t], [frame])


@pytest.mark.parametrize("seed", range(4))
def test_bsfe_on_made_up_frames(bsfe: ModuleType, tmp_path: Path, seed: int) -> None:
    kinds = [kind for kind in KINDS if kind not in ("no points", "all ground")]
    made = [made_up(kind, 100 * seed + number) for number, kind in enumerate(kinds)]
    write_log(tmp_path / "raw", made)
    write_bsfe_truth(tmp_path / "truth", [(frame.true, frame.category, frame.is_valid) for frame in made])
    log = AV2Log(tmp_path / "raw" / LOG, ground="bsfe")
    frames = []
    for number, frame in enumerate(made):
        sweep, following = log.sweep(number), log.sweep(number + 1)
        T = np.linalg.inv(following.pose) @ sweep.pose
        np.testing.assert_allclose(T, frame.T, atol=1e-9)
        assert 0 < sweep.is_ground.sum() < len(sweep.is_ground)
        labels = FlowLabels(total_flow(frame.points, frame.true, frame.T), frame.category, frame.is_valid)
        frames.append(
            EvalFrame(
                sweep.points,
                labels,
                residual_flow=frame.predicted,
                residual_axes="t",
                T_ego1_ego0=frame.T,
                is_ground=sweep.is_ground,
            )
        )
    check_bsfe(bsfe, f"made up {seed}", tmp_path / "raw", tmp_path / "truth", [f.predicted for f in made], frames)


@pytest.mark.parametrize("problem", ["nan", "nothing to score"])
def test_bsfe_stops_where_we_refuse_or_give_nan(bsfe: ModuleType, tmp_path: Path, problem: str) -> None:
    """A named difference: BucketedSceneFlowEval asserts where we raise (NaN) or return NaN (no point at all)."""
    made = made_up("random", 3)
    predicted = made.predicted.copy()
    if problem == "nan":
        predicted[:] = np.nan
    is_valid = np.ones_like(made.is_valid) if problem == "nan" else np.zeros_like(made.is_valid)
    write_log(tmp_path / "raw", [made])
    write_bsfe_truth(tmp_path / "truth", [(made.true, made.category, is_valid)])
    with pytest.raises(AssertionError):
        run_bsfe(bsfe, "bucketed_epe", tmp_path / "raw", tmp_path / "truth", [predicted])
    labels = FlowLabels(total_flow(made.points, made.true, made.T), made.category, is_valid)
    frame = EvalFrame(made.points, labels, residual_flow=predicted, residual_axes="t", T_ego1_ego0=made.T)
    ours: Optional[Dict[str, Any]] = None
    try:
        ours = score("bucketed_scene_flow_eval", [frame])
    except CFlowError as error:
        assert problem == "nan" and "have NaN" in str(error)
    if problem == "nothing to score":
        assert ours is not None and math.isnan(ours["bucketed"]["mean"]["static_epe"])
    else:
        assert ours is None
