"""Frames and logs for the public evaluators, and the comparison of their numbers with ours."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Dict, Iterable, Sequence, Tuple

import numpy as np
import pyarrow as pa
import pyarrow.feather as feather

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.categories import META_CLASSES
from cflow_torch.data.log import FlowLabels
from cflow_torch.evaluation import EvalFrame, SceneFlowMetrics

TOLERANCE = 1e-6
LOG, TIME = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede", 315966265259836000  # the real pair
FLOW = ("flow_tx_m", "flow_ty_m", "flow_tz_m")
EDGES = np.linspace(0, 2, 51)  # of the speed buckets
Comparison = Dict[str, Tuple[float, float]]


def score(definition: Any, frames: Iterable[EvalFrame]) -> dict[str, Any]:
    metrics = SceneFlowMetrics(definition)
    for frame in frames:
        metrics.update(frame)
    return metrics.compute()


def check(label: str, numbers: Comparison) -> None:
    """Assert that no number of ours differs from theirs by more than the tolerance; NaN equals NaN."""
    ours, theirs = np.array(list(numbers.values()), dtype=np.float64).T
    difference = np.where(np.isnan(ours) & np.isnan(theirs), 0.0, np.abs(ours - theirs))
    difference[np.isnan(difference)] = np.inf
    print(f"\n{label}: {len(numbers)} numbers, largest difference {difference.max():.2e}")
    assert {name: pair for pair, far, name in zip(numbers.values(), difference > TOLERANCE, numbers) if far} == {}


@dataclass(frozen=True)
class Pair:
    """The real pair of Argoverse 2 with its stored labels and two versions of its ego motion."""

    points: np.ndarray
    labels: FlowLabels
    is_ground: np.ndarray  # as the label file says
    bsfe_ground: np.ndarray
    T_float32: np.ndarray  # of the label file, 0.8 mm off the poses
    T_float64: np.ndarray  # from the poses


def read_pair(folder: Path) -> Pair:
    log = AV2Log(folder)
    now, following, labels = log.sweep(0), log.sweep(1), log.labels(0)
    assert labels is not None
    stored = feather.read_table(str(folder / "flow_labels.feather"))
    return Pair(
        points=now.points,
        labels=labels,
        is_ground=stored["is_ground_0"].to_numpy(),
        bsfe_ground=AV2Log(folder, ground="bsfe").sweep(0).is_ground,
        T_float32=np.load(folder / "ego_motion.npz")["ego_motion"][0].astype(np.float64),
        T_float64=np.linalg.inv(following.pose) @ now.pose,
    )


def official_mask(pair: Pair) -> np.ndarray:
    """Points that the challenge of 2023 scores."""
    return ~pair.is_ground & (np.abs(pair.points[:, :2]) <= 50).all(axis=1)


@dataclass(frozen=True)
class MadeUp:
    """A frame as BucketedSceneFlowEval has it: residuals in the axes of t."""

    points: np.ndarray
    true: np.ndarray
    predicted: np.ndarray
    category: np.ndarray
    is_valid: np.ndarray
    is_ground: np.ndarray
    T: np.ndarray

    @property
    def labels(self) -> FlowLabels:
        return FlowLabels(total_flow(self.points, self.true, self.T), self.category, self.is_valid)


def total_flow(points: np.ndarray, residual: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Total flow of residuals in the axes of t: T (p + r) - p."""
    start = points.astype(np.float64)
    return ((start + residual) @ T[:3, :3].T + T[:3, 3] - start).astype(np.float32)


def residual_at_t(pair: Pair) -> np.ndarray:
    """True residual of the real pair in the axes of t, by the float64 poses."""
    T, start = pair.T_float64, pair.points.astype(np.float64)
    return ((start + pair.labels.flow - T[:3, 3]) @ T[:3, :3] - start).astype(np.float32)


def write_table(file: Path, **columns: Any) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    feather.write_feather(pa.table(columns), str(file))


def write_bsfe_truth(root: Path, truths: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> Path:
    """Write truth for its loader: residual in the axes of t, category one lower than Argoverse 2's, valid rows."""
    for number, (residual, category, is_valid) in enumerate(truths):
        columns = dict(zip(FLOW, np.ascontiguousarray(residual.T)))
        classes = category.astype(np.int8) - np.int8(1)
        write_table(root / LOG / f"{number:010d}.feather", **columns, is_valid=is_valid, classes_0=classes)
    return root


def write_log(root: Path, made: Sequence[MadeUp]) -> Path:
    """Write a raw log of made-up frames and the first one again: a ground raster, and poses that chain the T."""
    folder, pose = root / LOG, np.eye(4)
    rows: list[list[float]] = []
    for number, frame in enumerate([*made, made[0]]):
        lidar = folder / "sensors" / "lidar" / f"{TIME + number}.feather"
        write_table(lidar, **dict(zip("xyz", frame.points.T.copy())))
        half_yaw = math.atan2(pose[1, 0], pose[0, 0]) / 2
        rows.append([math.cos(half_yaw), 0, 0, math.sin(half_yaw), *pose[:3, 3]])
        pose = pose @ np.linalg.inv(frame.T)
    columns = dict(zip(("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"), np.array(rows).T.copy()))
    write_table(folder / "city_SE3_egovehicle.feather", timestamp_ns=TIME + np.arange(len(rows)), **columns)
    (folder / "map").mkdir()
    heights = np.random.default_rng(0).choice([-9.0, -9.0, -9.0, 9.0, np.nan], (400, 400)).astype(np.float16)
    np.save(folder / "map" / f"{LOG}_ground_height_surface____MADE.npy", heights)
    alignment = {"R": [1.0, 0.0, 0.0, 1.0], "t": [100.0, 100.0], "s": 2.0}
    (folder / "map" / f"{LOG}___img_Sim2_city.json").write_text(json.dumps(alignment))
    return root


def bsfe_data_set(bsfe: ModuleType, raw: Path, truth: Path, kind: str, output: Path, with_ground: bool = False) -> Any:
    """Its data set of a raw log, with truth of `write_bsfe_truth`, for the evaluator `kind`, which writes `output`."""
    settings = {"with_ground": with_ground, "use_gt_flow": True, "cache_root": output, "use_cache": False}
    evaluation = {"eval_type": kind, "eval_args": {"output_path": output}}
    return bsfe.Argoverse2CausalSceneFlow(raw, flow_data_path=truth, **settings, **evaluation)


def bucket_numbers(ours: dict[str, Any], evaluator: Any, output: Path, distance: float = 35) -> Comparison:
    """Numbers per class, their means over classes, and points, mean error and mean speed per bucket."""
    from bucketed_scene_flow_eval.eval.base_per_frame_sceneflow_eval import PerFrameSceneFlowEvaluator

    numbers: Comparison = {}
    classes = evaluator.compute_results(return_distance_threshold=distance)
    cells = PerFrameSceneFlowEvaluator.compute_results(evaluator, save_results=False)
    for name, (static, dynamic) in classes.items():
        numbers[f"{name} static"] = ours["classes"][name]["static_epe"], static
        numbers[f"{name} dynamic"] = ours["classes"][name]["dynamic_error"], dynamic
        buckets = ours["classes"][name]["buckets"]
        members = "BACKGROUND" if name == "BACKGROUND" else META_CLASSES[name]
        own = [(key, cell) for key, cell in cells.items() if key.name in members and key.distance_threshold == distance]
        for number, edges in enumerate(zip(EDGES, [*EDGES[1:], math.inf])):
            found = [cell for key, cell in own if key.speed_thresholds == edges]
            count = sum(cell.count for cell in found)
            numbers[f"{name} {number} count"] = buckets["count"][number], count
            if count:
                error, speed = (sum(getattr(c, k) * c.count for c in found) / count for k in ("avg_epe", "avg_speed"))
                numbers[f"{name} {number} EPE"] = buckets["epe"][number], error
                numbers[f"{name} {number} speed"] = buckets["speed"][number], speed
    mean = json.loads((output / f"mean_average_results_{distance}.json").read_text())
    numbers["static"] = ours["mean"]["static_epe"], mean[0]
    numbers["dynamic"] = ours["mean"]["dynamic_error"], mean[1]
    return numbers


def three_way_numbers(ours: dict[str, Any], classes: dict[str, Any]) -> Comparison:
    assert set(classes) == {"BACKGROUND", "FOREGROUND"}
    numbers = {
        f"{name} {motion}": (ours["breakdown"][name.lower()][motion]["all"]["epe"], value)
        for name, values in classes.items()
        for motion, value in zip(("static", "dynamic"), values)
    }
    sets = {"epe_fd": classes["FOREGROUND"][1], "epe_fs": classes["FOREGROUND"][0], "epe_bs": classes["BACKGROUND"][0]}
    return {**numbers, **{name: (ours[name], value) for name, value in sets.items()}}
