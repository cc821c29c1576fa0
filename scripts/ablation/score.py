"""Figures of a setting on a set, kept one by one: a run that was interrupted resumes there."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Dict, List, Mapping, Sequence

import numpy as np
import torch
from sets import NEAR, PROFILES, ScoredSet

import cflow_torch
from cflow_torch import make_model
from cflow_torch.config import Config
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.records import strict, write_text
from cflow_torch.evaluation.bucketed import mean_of_present
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.masks import score_points
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.threeway import ThreeWayEPE

Figures = Dict[str, Any]
RANGES = {"near": "0-35", "far": "35-70"}
CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
DYNAMIC = 0.05  # metres per sweep
_FILES = ("made.py", "score.py", "sets.py")


def estimate(scored: ScoredSet, config: Config) -> List[EvalFrame]:
    """The frames of a set with the flow of one setting, window by window."""
    model, frames = make_model(config), []
    for item in scored.items():
        past, future = item.window.pch[: config.num_history], item.window.pcf[: config.num_future]
        window = replace(item.window, pch=past, pcf=future)
        frames.append(item.frame(model([window])[0].residual_flow))
    return frames


def pooled_figures(frames: Sequence[EvalFrame], step: int = 1, reach: float = NEAR) -> Figures:
    """Means over all points of a set in a square box around the sensor.

    Args:
        frames: windows with estimates.
        step: sweeps from t to t+1; a point is dynamic from 0.05 m per sweep on.
        reach: metres, half side of the box.

    Returns:
        "dynamic", "static": EPE in metres of dynamic objects, of the static background; "pedestrian": mean of error
        divided by speed of dynamic pedestrians; "num_dynamic", "num_pedestrian": points. NaN where there is nothing.
    """
    definition = Definition(
        name="pooled",
        metrics=("three_way",),
        region="box",
        max_range=reach,
        dynamic_threshold=DYNAMIC * step,
    )
    three_way = ThreeWayEPE(definition)
    num_dynamic, of_pedestrians = 0, []
    for frame in frames:
        points = score_points(frame, definition)
        three_way.update_points(points)
        moves = points.in_region & points.is_dynamic & (points.category > 0)
        num_dynamic += int(moves.sum())
        walks = moves & (points.category == CATEGORY_INDEX["PEDESTRIAN"])
        of_pedestrians.append(points.error[walks] / points.speed[walks])
    relative, means = np.concatenate(of_pedestrians), three_way.compute()
    return {
        "dynamic": means["epe_fd"],
        "static": means["epe_bs"],
        "pedestrian": float(relative.mean()) if relative.size else float("nan"),
        "num_dynamic": num_dynamic,
        "num_pedestrian": relative.size,
    }


def simulated_figures(frames: Sequence[EvalFrame]) -> Figures:
    """`pooled_figures`, and dynamic bucket-normalised errors within 35 m and at 35-70 m.

    Returns:
        Besides, for "near" and "far": the mean over classes; "near CAR", "far CAR", ...: each class; and "sums": what
        `with_means` needs for the classes over several sets.
    """
    metrics = SceneFlowMetrics("challenge_2026_box")
    for frame in frames:
        metrics.update(frame)
    figures, by_range = pooled_figures(frames), metrics.parts["bucketed_by_range"]
    figures.update(_by_class(by_range))
    ranges = by_range.compute()["ranges"]
    figures.update({name: ranges[key]["mean"]["dynamic_error"] for name, key in RANGES.items()})
    figures["sums"] = {total: getattr(by_range, total).tolist() for total in by_range.totals}
    return figures


def with_means(scores: Mapping[str, Figures]) -> Dict[str, Figures]:
    """The figures by set and, per range of seeds and h, the means over the sensors; classes over all their points."""
    result = dict(scores)
    for mean_name in dict.fromkeys(map(_mean_name, filter(_is_of_sensor, scores))):
        parts = [part for name, part in scores.items() if _is_of_sensor(name) and _mean_name(name) == mean_name]
        by_range = SceneFlowMetrics("challenge_2026_box").parts["bucketed_by_range"]
        for total in by_range.totals:
            setattr(by_range, total, np.sum([part["sums"][total] for part in parts], axis=0))
        keys = ("near", "far", "static", "dynamic")
        means = {key: mean_of_present(np.array([part[key] for part in parts])) for key in keys}
        result[mean_name] = {**means, **_by_class(by_range)}
    return result


class Store:
    """Figures by set and setting, a JSON file each.

    Args:
        folder: where they are kept.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, scored: ScoredSet, config: Config) -> Figures:
        """Figures of a setting on a set: those that are kept, else new ones."""
        about = {"set": scored.name, "config": strict(config.as_dict())}
        name = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]
        file = self.folder / f"{scored.name.replace(' ', '-')}-{name}.json"
        if file.is_file():
            record = json.loads(file.read_text(encoding="utf-8"))
            if record["code"] == code_key():
                return _nan_for_null(record["figures"])
        frames = estimate(scored, config)
        figures = simulated_figures(frames) if scored.group.startswith("sim") else pooled_figures(frames, scored.step)
        record = {**about, "code": code_key(), "num_windows": len(frames), "figures": figures}
        write_text(file, json.dumps(strict(record), indent=1))
        return figures


@lru_cache(maxsize=None)
def code_key() -> str:
    """Digest of the code that figures depend on."""
    digest = hashlib.sha256(torch.__version__.encode())
    files = [*Path(cflow_torch.__file__).parent.rglob("*.py"), *map(Path(__file__).with_name, _FILES)]
    for file in sorted(files):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _by_class(by_range: Any) -> Figures:
    """Dynamic bucket-normalised error of each class: "near CAR", ..."""
    ranges = by_range.compute()["ranges"]
    classes = {name: ranges[key]["classes"] for name, key in RANGES.items()}
    return {f"{name} {c}": of_class[c]["dynamic_error"] for name, of_class in classes.items() for c in CLASSES}


def _is_of_sensor(name: str) -> bool:
    return name.startswith("sim ") and name.split()[1] in PROFILES


def _mean_name(name: str) -> str:
    """ "sim waymo 100-103 h=4" -> "sim 100-103 h=4"."""
    words = name.split()
    return " ".join([words[0], *words[2:]])


def _nan_for_null(value: Any) -> Any:
    """JSON has no NaN; figures have no None."""
    if isinstance(value, dict):
        return {key: _nan_for_null(part) for key, part in value.items()}
    return float("nan") if value is None else value
