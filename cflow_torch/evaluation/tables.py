"""Scores as text that reads well in a terminal and renders as Markdown."""

from __future__ import annotations

import math
from typing import Any, Dict, List, Sequence


def format_table(results: Dict[str, Any]) -> str:
    """Tables of the bucketed (also by range), three-way and range-wise scores that `SceneFlowMetrics.compute` returned.

    Args:
        results: what `compute` returned; metrics that the definition lacks are left out.

    Returns:
        Markdown, one table per metric; "-" where there are no points.
    """
    lines = [
        f"definition {results['definition']}: {results['num_frames']} frames, {results['num_points']} points scored, "
        f"{results['num_nan']} left out for NaN"
    ]
    if "bucketed" in results:
        classes, mean = results["bucketed"]["classes"], results["bucketed"]["mean"]
        rows = [
            [name, _number(row["static_epe"]), _number(row["dynamic_error"]), row["num_static"], row["num_dynamic"]]
            for name, row in classes.items()
        ]
        rows.append(["**mean**", _number(mean["static_epe"]), _number(mean["dynamic_error"]), "", ""])
        lines += ["", *_table(["class", "static EPE [m]", "dynamic error", "static points", "dynamic points"], rows)]
    if "bucketed_by_range" in results:
        by_range = results["bucketed_by_range"]
        names = list(next(iter(by_range["ranges"].values()))["classes"])
        moving = [name for name in names if name != "BACKGROUND"]
        rows = [
            [
                name,
                *(_number(scores["classes"][column]["dynamic_error"]) for column in moving),
                _number(scores["mean"]["dynamic_error"]),
            ]
            for name, scores in by_range["ranges"].items()
        ]
        rows.append(["**mean**", *("" for _ in moving), _number(by_range["mean"]["dynamic_error"])])
        lines += ["", *_table(["dynamic error, range [m]", *moving, "mean"], rows)]
    if "three_way" in results:
        scores = results["three_way"]
        keys = ["epe_3way", "epe_fd", "epe_fs", "epe_bs", "dynamic_iou"]
        header = ["EPE 3-way [m]", "EPE FD [m]", "EPE FS [m]", "EPE BS [m]", "dynamic IoU"]
        lines += ["", *_table(header, [[_number(scores[key]) for key in keys]])]
    if "range_wise" in results:
        rows = [
            [
                f"**{name}**" if name == "mean" else name,
                _number(row["static_epe"]),
                _number(row["dynamic_epe"]),
                row.get("num_static", ""),
                row.get("num_dynamic", ""),
            ]
            for name, row in results["range_wise"].items()
        ]
        lines += [
            "",
            *_table(["range [m]", "static EPE [m]", "dynamic EPE [m]", "static points", "dynamic points"], rows),
        ]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> List[str]:
    """Lines of a Markdown table, first column flush left, others flush right."""
    cells = [[str(cell) for cell in row] for row in (header, *rows)]
    widths = [max(len(row[column]) for row in cells) for column in range(len(header))]
    aligned = [
        [
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths))
        ]
        for row in cells
    ]
    rule = ["-" * width if column == 0 else "-" * (width - 1) + ":" for column, width in enumerate(widths)]
    return ["| " + " | ".join(row) + " |" for row in (aligned[0], rule, *aligned[1:])]
