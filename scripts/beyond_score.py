"""Figures of a setting on a set, kept one by one, so that a run that was cut short goes on where it ended."""

from __future__ import annotations

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any, Dict, List, Sequence

import numpy as np
import torch
from beyond_sets import NEAR, ScoredSet

import cflow_torch
from cflow_torch import make_model
from cflow_torch.config import Config
from cflow_torch.data.records import strict, write_text
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.masks import score_points
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.threeway import ThreeWayEPE

Figures = Dict[str, Any]
RANGES = {"near": "0-35", "far": "35-70"}
CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
DYNAMIC = 0.05  # metres per sweep
_FILES = ("beyond_made.py", "beyond_score.py", "beyond_sets.py")


def estimate(scored: ScoredSet, config: Config) -> List[EvalFrame]:
    """The frames of a set with the flow of one setting, window by window."""
    model = make_model(config)
    return [item.frame(model([item.window])[0].residual_flow) for item in scored.items()]


def pooled_figures(frames: Sequence[EvalFrame], step: int = 1) -> Figures:
    """Means over all points of a set within 35 m.

    Args:
        frames: windows with estimates.
        step: sweeps from t to t+1; a point is dynamic from 0.05 m per sweep on.

    Returns:
        "dynamic", "static": EPE in metres of dynamic objects, of the static background; "relative", "pedestrian": mean
        of error divided by speed of dynamic objects, of dynamic pedestrians; "num_dynamic", "num_pedestrian": points.
        NaN where there is nothing.
    """
    definition = Definition(
        name="pooled",
        metrics=("three_way",),
        region="box",
        max_range=NEAR,
        dynamic_threshold=DYNAMIC * step,
    )
    three_way = ThreeWayEPE(definition)
    relative, is_pedestrian = [], []
    for frame in frames:
        points = score_points(frame, definition)
        three_way.update_points(points)
        moves = points.in_region & points.is_dynamic & (points.category > 0)
        relative.append(points.error[moves] / points.speed[moves])
        is_pedestrian.append(points.category[moves] == CATEGORY_INDEX["PEDESTRIAN"])
    of_points, walks = np.concatenate(relative), np.concatenate(is_pedestrian)
    means = three_way.compute()
    return {
        "dynamic": means["epe_fd"],
        "static": means["epe_bs"],
        "relative": _mean(of_points),
        "pedestrian": _mean(of_points[walks]),
        "num_dynamic": len(of_points),
        "num_pedestrian": int(walks.sum()),
    }


def simulated_figures(frames: Sequence[EvalFrame]) -> Figures:
    """`pooled_figures`, and dynamic bucket-normalised errors within 35 m and at 35-70 m.

    Returns:
        Besides, for "near" and "far": the mean over classes; "near_classes", "far_classes": each class;
        "far_static": EPE of the background there; and "sums": what `merge_classes` needs.
    """
    metrics = SceneFlowMetrics("challenge_2026_box")
    for frame in frames:
        metrics.update(frame)
    figures = pooled_figures(frames)
    ranges = metrics.compute()["bucketed_by_range"]["ranges"]
    for name, key in RANGES.items():
        scores = ranges[key]
        figures[name] = scores["mean"]["dynamic_error"]
        figures[f"{name}_classes"] = {c: scores["classes"][c]["dynamic_error"] for c in CLASSES}
    figures["far_static"] = ranges[RANGES["far"]]["classes"]["BACKGROUND"]["static_epe"]
    by_range = metrics.parts["bucketed_by_range"]
    figures["sums"] = {total: getattr(by_range, total).tolist() for total in by_range.totals}
    return figures


def merge_classes(parts: Sequence[Figures]) -> Dict[str, Dict[str, float]]:
    """Dynamic bucket-normalised error of each class, "near" and "far", over the points of several sets together."""
    metrics = SceneFlowMetrics("challenge_2026_box")
    by_range = metrics.parts["bucketed_by_range"]
    for total in by_range.totals:
        setattr(by_range, total, np.sum([part["sums"][total] for part in parts], axis=0))
    ranges = by_range.compute()["ranges"]
    return {name: {c: ranges[key]["classes"][c]["dynamic_error"] for c in CLASSES} for name, key in RANGES.items()}


class Store:
    """Figures by set and setting, a JSON file each.

    Args:
        folder: where they are kept.
        any_code: also take figures that another version of the code made.
    """

    def __init__(self, folder: Path, any_code: bool = False) -> None:
        self.folder, self.any_code = folder, any_code

    def get(self, scored: ScoredSet, config: Config) -> Figures:
        """Figures of a setting on a set: those that are kept, else new ones."""
        about = {"set": scored.name, "config": changed(config)}
        name = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
        file = self.folder / f"{scored.name.replace(' ', '-')}-{name}.json"
        if file.is_file():
            record = json.loads(file.read_text(encoding="utf-8"))
            if self.any_code or record["code"] == code_key():
                return _nan_for_null(record["figures"])
        frames = estimate(scored, config)
        figures = simulated_figures(frames) if scored.group.startswith("sim") else pooled_figures(frames, scored.step)
        record = {**about, "code": code_key(), "num_windows": len(frames), "figures": figures}
        write_text(file, json.dumps(strict(record), indent=1))
        return figures


def changed(config: Config) -> Dict[str, Any]:
    """The fields that differ from those of the paper's preset."""
    paper = Config().as_dict()
    different = {key: value for key, value in config.as_dict().items() if value != paper[key]}
    different: Dict[str, Any] = strict(different)
    return different


@lru_cache(maxsize=None)
def code_key() -> str:
    """Digest of the code that figures depend on."""
    digest = hashlib.sha256(torch.__version__.encode())
    files = [*Path(cflow_torch.__file__).parent.rglob("*.py"), *map(Path(__file__).with_name, _FILES)]
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")


def _nan_for_null(value: Any) -> Any:
    """JSON has no NaN; figures have no None."""
    if isinstance(value, dict):
        return {key: _nan_for_null(part) for key, part in value.items()}
    return float("nan") if value is None else value
