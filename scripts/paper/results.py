"""Load the paper's numbers and our results files, both by experiment and row."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Dict, Mapping

from omegaconf import OmegaConf

from cflow_torch.config import PRESETS
from cflow_torch.evaluation.metrics import ProtocolScores, errors_by_range, score_data_sets

PAPER_FILE = Path(__file__).resolve().with_name("figures.yaml")
# The paper's name of a class -> its name in the evaluation.
CLASSES = {"CAR": "CAR", "OTHER": "OTHER_VEHICLES", "PED": "PEDESTRIAN", "VRU": "WHEELED_VRU"}
METHODS = {"dense": "CorrelationFlow", "keypoints": "CorrelationFlow-Keypoint"}
RANGES = ("0-35", "35-70")
DENSIFIED = {
    "components": "Connected components",
    "nearest": "Nearest neighbour",
    "clusters": "Clusters (not in the paper)",
}
PRESET = "Preset keypoints (not in the paper)"
STAGES = {"views": ("correlate", "pool"), "clustering": ("cluster",)}  # stages in the paper's time column


@dataclass(frozen=True)
class Run:
    """One results file."""

    experiment: str  # name of the table or figure
    data_set: str  # its name in the tables
    row: str  # row of the table, or point of the figure
    record: dict[str, Any]  # content of results.json

    def values(self) -> list[float]:
        """Dynamic bucket-normalised error of CAR, OTHER, PED, VRU, and their mean; NaN = no moving points."""
        scores = self.record["results"]["bucketed"]
        classes = [scores["classes"][name]["dynamic_error"] for name in CLASSES.values()]
        return [math.nan if value is None else value for value in (*classes, scores["mean"]["dynamic_error"])]

    def seconds(self) -> float:
        """Median seconds per pair of the stages in the paper's time column."""
        times = self.record["seconds_per_pair"]
        stages = STAGES.get(self.experiment)
        return float(times["median"] if stages is None else sum(times["stages"].get(name, 0.0) for name in stages))


Ours = Mapping[str, Mapping[str, Run]]  # data set -> row
Runs = Dict[str, Dict[str, Dict[str, Run]]]  # experiment -> data set -> row


def load_paper() -> dict[str, Any]:
    """Load the paper's numbers by experiment. Figures of classes get `rows` like tables."""
    paper: dict[str, Any] = OmegaConf.to_container(OmegaConf.load(PAPER_FILE))  # type: ignore[assignment]
    for name in ("history", "scales"):
        figure, rows = paper[name], {}
        for index, x in enumerate(figure["at"]):
            for h in ("",) if name == "history" else ("h=0", "h=2", "h=4"):
                lines = {c: figure["lines"][c] if name == "history" else figure["panels"][c][h] for c in CLASSES}
                values = [lines[c][index] for c in CLASSES]
                rows[f"h={x}" if name == "history" else f"{h}, {x} scales"] = [*values, sum(values) / len(values)]
        figure["rows"], figure["row"] = dict(sorted(rows.items(), key=lambda row: row[0].split(",")[0])), "setting"
    return paper


def row_of(experiment: str, model: dict[str, Any]) -> str:
    """The row of a table to which the settings of a run belong."""
    sizes, h = model["pixel_sizes"], model.get("num_history", 0)
    if experiment == "pixel_size":
        return ", ".join(f"{size:g}" for size in sizes)
    if experiment == "views":
        return "+Sectional" if model["sectional_view"] else "BEV"
    if experiment == "clustering":
        return "HDBSCAN" if model["clustering"] == "hdbscan" else "Connected components"
    if experiment == "history":
        return f"h={h}"
    if experiment == "scales":
        return f"h={h}, {len(sizes)} scales"
    if experiment == "keypoints":
        if model["method"] == "dense":
            return f"CorrelationFlow (h={h})"
        is_preset = model["densify"] == "clusters" and model["patch_size"] == PRESETS["keypoints"][1]["patch_size"]
        return PRESET if is_preset else DENSIFIED[model["densify"]]
    return METHODS[model["method"]]


def load_runs(folder: Path) -> tuple[Runs, list[str]]:
    """Load the latest run of each row below a folder; also returns remarks on files that cannot be used."""
    runs: Runs = {}
    remarks: list[str] = []
    for file in sorted(folder.rglob("results.json")):
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            config = record["config"]
            experiment = config.get("experiment_name")
        except (ValueError, KeyError, TypeError) as error:
            remarks.append(f"{file} is not a results file of this version ({error!r})")
            continue
        if experiment is None:
            continue
        data = config["data"]
        name = data["label"] + (f" ({data['profile']})" if data["name"] == "benchmark" else "")
        run = Run(experiment, name, row_of(experiment, config["model"]), record)
        rows = runs.setdefault(experiment, {}).setdefault(name, {})
        rows[run.row] = max(run, rows.get(run.row, run), key=lambda each: each.record["date"])
    return runs, remarks


def range_errors(run: Run) -> list[float]:
    """Error of a run of `datasets` or `range_split` at short and long range; NaN = no moving points."""
    errors = errors_by_range(run.record["results"])
    return [errors[name] for name in RANGES]


def protocol(ours: Ours) -> dict[str, ProtocolScores]:
    """Scores of our variants over our data sets, combined as in the challenge: method -> scores."""
    result = {}
    for method in METHODS.values():
        errors = {name: dict(zip(RANGES, range_errors(runs[method]))) for name, runs in ours.items() if method in runs}
        if errors:
            result[method] = score_data_sets(errors, data_sets=list(ours), ranges=RANGES)
    return result
