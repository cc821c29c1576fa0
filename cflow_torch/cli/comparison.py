"""The most important scores of a run in one line, and a table that compares the jobs of a sweep."""

from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

from hydra.experimental.callback import Callback

from cflow_torch.cli.choices import free_names
from cflow_torch.cli.commands import Eval
from cflow_torch.cli.settings import as_yaml

RESULTS = "results.json"
COMPARISON = "comparison.csv"
# The scores of a class with fewer dynamic points are uncertain. One pedestrian has about 1000 in ten sweeps.
_FEW = 1000
FAILED = "failed pairs or logs"
_SCORES = {  # those that no job has are left out
    "moving IoU": "moving_iou",
    "mean dynamic error": "dynamic_error",
    "EPE FD [m]": "epe_fd",
    "EPE BS [m]": "epe_bs",
    "seconds a frame": "seconds",
    FAILED: "failed",
}


class Comparison(Callback):
    """After `cflow eval -m`, print a table of all jobs in OUTPUT, and write it to OUTPUT/comparison.csv.

    The exit status is 1 if pairs or logs of one of these jobs failed.
    """

    def on_multirun_end(self, config: Any, **kwargs: Any) -> None:
        if "experiment_name" not in config:  # another command
            return
        from cflow_torch.data.atomic import write_text
        from cflow_torch.data.paths import as_path
        from cflow_torch.evaluation.tables import markdown

        output = as_path(config["output"])
        header, rows = compare(output)
        if rows:
            text = io.StringIO()
            csv.writer(text, lineterminator="\n").writerows([header, *rows])
            write_text(output / COMPARISON, text.getvalue())
            shown = [[f"{cell:.4g}" if isinstance(cell, float) else cell for cell in row] for row in rows]
            print("\n".join([f"all jobs in {output}, also in {output / COMPARISON}:", "", *markdown(header, shown)]))
        if FAILED in header:
            raise SystemExit(1)


def compare(output: Path) -> tuple[list[str], list[list[Any]]]:
    """Compare all jobs with results below a folder: a header, and a row for each job.

    A row has the settings in which the jobs differ, then the scores; "" = no value. If the jobs have scored different
    data, the digest of the data is between them.
    """
    jobs: list[tuple[dict[str, str], list[Any]]] = []
    columns: dict[str, None] = {}
    for file in sorted(output.glob(f"*/**/{RESULTS}")):
        try:
            record = json.loads(file.read_text(encoding="utf-8"))
            scores = headline(record["results"], record["seconds_per_pair"])
            scores["failed"] = len(record["failures"]) or math.nan
            settings, named = _settings(record["config"])
            settings["scored data"] = record["data"]["digest"]
        except (ValueError, KeyError, TypeError) as error:
            print(f"{file} is not compared: it is not a results file of this version ({error!r})")
            continue
        columns.update(dict.fromkeys(named))
        jobs.append((settings, ["" if math.isnan(scores[key]) else scores[key] for key in _SCORES.values()]))
    shown = [k for k in range(len(_SCORES)) if any(scores[k] != "" for _, scores in jobs)]
    names = [name for name in (*columns, "scored data") if len({settings.get(name, "") for settings, _ in jobs}) > 1]
    rows = [[settings.get(name, "") for name in names] + [scores[k] for k in shown] for settings, scores in jobs]
    rows.sort(key=lambda row: [_order(cell) for cell in row[: len(names)]])
    return [*names, *(list(_SCORES)[k] for k in shown)], rows


def _settings(config: dict[str, Any]) -> tuple[dict[str, str], list[str]]:
    """Return the settings of a job, and the names of those that describe it.

    A method has many settings: its preset describes it, and those that differ from this preset.
    """
    from cflow_torch.config import PRESETS
    from cflow_torch.data.json_file import json_ready
    from cflow_torch.fleet.changes import flatten, nearest_preset

    preset = nearest_preset(config["model"])
    of_preset = {} if preset is None else flatten(json_ready(PRESETS[preset].as_dict()), "model")
    free = free_names(Eval)
    settings = {name: value for name, value in flatten(config).items() if name not in free}
    named = [name for name, value in settings.items() if name not in of_preset or value != of_preset[name]]
    texts = {name: as_yaml(value) for name, value in settings.items()}
    return {"model": str(preset), **texts}, ["model", *named]


def _order(cell: str) -> tuple[bool, float, str]:
    """Sort key: numbers by size, before all other values."""
    try:
        return False, float(cell), ""
    except ValueError:
        return True, 0.0, cell


def headline(results: dict[str, Any], seconds: dict[str, Any]) -> dict[str, float]:
    """The most important scores of `SceneFlowMetrics.compute` and of `time_report`; NaN = no value.

    "dynamic_error" (mean over classes, and over ranges if the definition has them), "static_epe" (mean over classes),
    "epe_fd" and "epe_bs" in metres, "moving_iou", "seconds" (median per pair).
    """
    bucketed, three_way = results.get("bucketed", {}).get("mean", {}), results.get("three_way", {})
    found = {
        "dynamic_error": results.get("bucketed_by_range", {}).get("mean", bucketed).get("dynamic_error"),
        "static_epe": bucketed.get("static_epe"),
        "epe_fd": three_way.get("epe_fd"),
        "epe_bs": three_way.get("epe_bs"),
        "moving_iou": results.get("moving", {}).get("iou"),
        "seconds": seconds.get("median"),
    }
    return {name: math.nan if value is None else float(value) for name, value in found.items()}


def summary(results: dict[str, Any], seconds: dict[str, Any]) -> str:
    """Return a line with the most important scores and, if classes have few dynamic points, a line that lists these."""
    scores = headline(results, seconds)
    dynamic, static = "mean dynamic error {dynamic_error:.3f}", "static EPE {static_epe:.3f} m"
    if "moving" in results:
        found = {name: math.nan if value is None else value for name, value in results["moving"].items()}
        dynamic = "moving IoU {iou:.3f}".format(**found)
        static = "precision {precision:.3f}, recall {recall:.3f}".format(**found)
    elif "bucketed" not in results:
        dynamic, static = "EPE FD {epe_fd:.3f} m", "EPE BS {epe_bs:.3f} m"
    lines = [f"{dynamic}, {static}, {{seconds:.2f}} s a frame".format(**scores)]
    classes = results.get("bucketed", {}).get("classes", {})
    few = [f"{name} ({row['num_dynamic']})" for name, row in classes.items() if 0 < row["num_dynamic"] < _FEW]
    if few:
        lines.append(f"few dynamic points, so these classes are uncertain, and the mean with them: {', '.join(few)}")
    return "\n".join(lines)
