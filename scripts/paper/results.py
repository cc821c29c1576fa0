"""The numbers of the paper and of our results files, as lines of tables."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Dict, Mapping, Tuple

from omegaconf import OmegaConf

from cflow_torch.config import PRESETS
from cflow_torch.evaluation.metrics import ProtocolScores, errors_by_range, score_data_sets

PAPER_FILE = Path(__file__).resolve().with_name("figures.yaml")
# The paper's name of a class -> its name in the evaluation.
CLASSES = {"CAR": "CAR", "OTHER": "OTHER_VEHICLES", "PED": "PEDESTRIAN", "VRU": "WHEELED_VRU"}
CLASS_COLUMNS = (*CLASSES, "mean", "time")
METHODS = {"dense": "CorrelationFlow", "keypoints": "CorrelationFlow-Keypoint"}
RANGES = ("0-35", "35-70")
DENSIFIED = {
    "components": "Connected components",
    "nearest": "Nearest neighbour",
    "clusters": "Clusters (not in the paper)",
}
PRESET = "Preset keypoints (not in the paper)"
STAGES = {"views": ("correlate", "pool"), "clustering": ("cluster",)}  # stages in the paper's time column

Numbers = Dict[str, float]  # column -> number
Line = Tuple[str, str, Numbers]  # row of a table, "paper" or the name of our data, numbers; absent = unknown
Records = Dict[str, Dict[str, Dict[str, Any]]]  # data set -> row -> content of results.json


def load_paper() -> dict[str, Any]:
    """Load the paper's numbers: experiment -> description, with row -> numbers in "rows"."""
    paper: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(PAPER_FILE))  # type: ignore[assignment]
    for about in paper.values():
        columns = about.get("columns", CLASS_COLUMNS)
        about["rows"] = {row: dict(zip(columns, values)) for row, values in about["rows"].items()}
        if "columns" not in about:
            for numbers in about["rows"].values():
                numbers.setdefault("mean", sum(numbers.values()) / len(numbers))
    return paper


def load_runs(folder: Path) -> dict[str, Records]:
    """Load the latest run of each row below a folder, by experiment."""
    runs: dict[str, Records] = {}
    for file in sorted(folder.rglob("results.json")):
        record = json.loads(file.read_text(encoding="utf-8"))
        experiment, data = record["config"].get("experiment_name"), record["config"]["data"]
        if experiment is not None:
            name = data["label"] + (f" ({data['profile']})" if data["name"] == "benchmark" else "")
            row = row_of(experiment, record["config"]["model"])
            rows = runs.setdefault(experiment, {}).setdefault(name, {})
            rows[row] = max(record, rows.get(row, record), key=lambda each: each["date"])
    return runs


def row_of(experiment: str, model: dict[str, Any]) -> str:
    sizes, h = model["pixel_sizes"], model.get("num_history", 0)
    if experiment == "keypoints" and model["method"] == "keypoints":
        is_preset = model["densify"] == "clusters" and model["patch_size"] == PRESETS["keypoints"].patch_size
        return PRESET if is_preset else DENSIFIED[model["densify"]]
    rows = {
        "pixel_size": ", ".join(f"{size:g}" for size in sizes),
        "views": "+Sectional" if model.get("sectional_view") else "BEV",
        "clustering": "HDBSCAN" if model.get("clustering") == "hdbscan" else "Connected components",
        "history": f"h={h}",
        "scales": f"h={h}, {len(sizes)} scales",
        "keypoints": f"CorrelationFlow (h={h})",
    }
    return rows.get(experiment, METHODS.get(model["method"], model["method"]))


def make_lines(experiment: str, about: dict[str, Any], ours: Records) -> list[Line]:
    """Lines of the paper and ours. Rows of classes are next to each other; our rows of methods follow the paper's."""
    if "columns" in about:
        paper = [(row, "paper", numbers) for row, numbers in about["rows"].items()]
        return paper + [(row, "ours", numbers) for row, numbers in _of_methods(experiment, ours).items()]
    rows_of = {data_set: _of_classes(experiment, about, rows) for data_set, rows in ours.items()}
    lines: list[Line] = []
    for row in dict.fromkeys([*about["rows"], *(row for rows in rows_of.values() for row in rows)]):
        if row in about["rows"]:
            lines.append((row, "paper", about["rows"][row]))
        lines += [(row, data_set, rows.get(row, {})) for data_set, rows in rows_of.items()]
    return lines


def _of_classes(experiment: str, about: dict[str, Any], records: Mapping[str, Any]) -> dict[str, Numbers]:
    """Dynamic bucket-normalised errors of a data set by row, and median seconds per pair of the paper's stages."""
    rows: dict[str, Numbers] = {}
    for row, record in records.items():
        scores, times = record["results"]["bucketed"], record["seconds_per_pair"]
        parts = [*(scores["classes"][name] for name in CLASSES.values()), scores["mean"]]
        errors = [math.nan if part["dynamic_error"] is None else part["dynamic_error"] for part in parts]
        stages = STAGES.get(experiment)
        seconds = times["median"] if stages is None else sum(times["stages"].get(name, 0.0) for name in stages)
        rows[row] = dict(zip(CLASS_COLUMNS, [*errors, seconds]))
    if "difference_to" in about:
        base = rows.get(about["difference_to"], {})
        for row in rows.keys() - {about["difference_to"]}:
            rows[row] = {column: value - base.get(column, math.nan) for column, value in rows[row].items()}
    return rows


def _of_methods(experiment: str, ours: Records) -> dict[str, Numbers]:
    """Errors of our methods by row: combined as in the challenge (`datasets`), or at short and long range."""
    if experiment == "datasets":
        scores = protocol(ours)
        rows = {name: {method: score.data_sets[name] for method, score in scores.items()} for name in ours}
        return {"Overall": {method: score.overall for method, score in scores.items()}, **rows} if scores else rows
    return {
        f"{name} {reach} m": {method: errors_by_range(run["results"])[reach] for method, run in runs.items()}
        for name, runs in ours.items()
        for reach in RANGES
    }


def protocol(ours: Records) -> dict[str, ProtocolScores]:
    """Scores of our variants over our data sets, combined as in the challenge: method -> scores."""
    result = {}
    for method in METHODS.values():
        errors = {name: errors_by_range(runs[method]["results"]) for name, runs in ours.items() if method in runs}
        if errors:
            result[method] = score_data_sets(errors, data_sets=list(ours), ranges=RANGES)
    return result
