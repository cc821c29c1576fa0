"""Scores as Markdown tables, aligned for a terminal."""

from __future__ import annotations

import math
from typing import Any, Callable, List, Sequence, Tuple

TextTable = Tuple[List[str], List[List[Any]]]


def format_table(results: dict[str, Any]) -> str:
    """Format the result of `SceneFlowMetrics.compute` as Markdown, one table per metric.

    The result may come from a JSON file, which has null instead of NaN. Metrics that the definition lacks have no
    table. A "-" means that there are no points.
    """
    scored = "{num_frames} frames, {num_points} points scored, {num_nan} ignored because of NaN"
    lines = [f"definition {results['definition']}: {scored.format_map(results)}"]
    for metric, table in _TABLES.items():
        if metric in results:
            header, rows = table(results[metric])
            lines += ["", *markdown(header, rows)]
    return "\n".join(lines) + "\n"


def _static_and_dynamic(of: str, title: str, key: str, scores: dict[str, Any]) -> TextTable:
    rows = []
    for name, row in scores.items():
        counts = [row.get("num_static", ""), row.get("num_dynamic", "")]
        label = "**mean**" if name == "mean" else name
        rows.append([label, _number(row["static_epe"]), _number(row[key]), *counts])
    return [of, "static EPE [m]", title, "static points", "dynamic points"], rows


def _by_range(scores: dict[str, Any]) -> TextTable:
    classes = next(iter(scores["ranges"].values()))["classes"]
    moving = [name for name in classes if name != "BACKGROUND"]
    rows = []
    for name, own in scores["ranges"].items():
        columns = [*(own["classes"][column] for column in moving), own["mean"]]
        rows.append([name, *(_number(column["dynamic_error"]) for column in columns)])
    rows.append(["**mean**", *("" for _ in moving), _number(scores["mean"]["dynamic_error"])])
    return ["dynamic error, range [m]", *moving, "mean"], rows


def _three_way(scores: dict[str, Any]) -> TextTable:
    keys = ("epe_3way", "epe_fd", "epe_fs", "epe_bs", "dynamic_iou")
    titles = ["EPE 3-way [m]", "EPE FD [m]", "EPE FS [m]", "EPE BS [m]", "dynamic IoU"]
    return titles, [[_number(scores[key]) for key in keys]]


def _moving(scores: dict[str, Any]) -> TextTable:
    ratios = [_number(scores[key]) for key in ("iou", "precision", "recall")]
    counts = [scores[key] for key in ("num_moving", "num_predicted", "num_points")]
    titles = ["moving IoU", "precision", "recall", "moving points", "predicted", "points"]
    return titles, [[*ratios, *counts]]


_TABLES: dict[str, Callable[[dict[str, Any]], TextTable]] = {
    "bucketed": lambda scores: _static_and_dynamic(
        "class", "dynamic error", "dynamic_error", {**scores["classes"], "mean": scores["mean"]}
    ),
    "bucketed_by_range": _by_range,
    "three_way": _three_way,
    "range_wise": lambda scores: _static_and_dynamic("range [m]", "dynamic EPE [m]", "dynamic_epe", scores),
    "moving": _moving,
}


def _number(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.4f}"


def markdown(header: Sequence[object], rows: Sequence[Sequence[object]]) -> list[str]:
    """Return the lines of a Markdown table, the first column left-aligned, the others right-aligned."""
    cells = [[str(cell) for cell in row] for row in (header, *rows)]
    first, *others = [max(len(cell) for cell in column) for column in zip(*cells)]
    lines = [[row[0].ljust(first), *(cell.rjust(width) for cell, width in zip(row[1:], others))] for row in cells]
    lines.insert(1, ["-" * first, *("-" * (width - 1) + ":" for width in others)])
    return ["| " + " | ".join(line) + " |" for line in lines]
