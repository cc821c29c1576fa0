"""The ablation as a Markdown table and as CSV."""

from __future__ import annotations

import math
from typing import Any, List, Mapping, Sequence

from score import CLASSES, Figures

Cells = List[List[str]]


def shown_cells(scores: Mapping[str, Mapping[str, Figures]]) -> Cells:
    """Header and rows of the page: a column per set; of the simulated ones the means over the sensors.

    Args:
        scores: by setting, then by set, with means.
    """
    first = next(iter(scores.values()))
    real = [name for name in first if not name.startswith("sim ")]
    means = [name for name, figures in first.items() if name.startswith("sim ") and "sums" not in figures]
    cells = [["", *real, *means, *(f"{name}: CAR OTHER PED WHEELED" for name in means)]]
    for setting, figures in scores.items():
        row = [setting]
        for name in real:
            keys = ("dynamic", "pedestrian", "static") if name == "kitti h=0" else ("dynamic", "static")
            row.append(" / ".join(number(figures[name][key]) for key in keys))
        row += [" / ".join(number(figures[name][key]) for key in ("near", "far", "static")) for name in means]
        row += [" ".join(number(figures[name][f"near {c}"]) for c in CLASSES) for name in means]
        cells.append(row)
    return cells


def flat_cells(scores: Mapping[str, Mapping[str, Figures]]) -> Cells:
    """Header and rows: a column per figure of every set, for programs."""
    columns = []
    for set_name, part in next(iter(scores.values())).items():
        columns += [(set_name, key) for key, value in part.items() if isinstance(value, (int, float))]
    rows = [[name, *(number(figures[of][key]) for of, key in columns)] for name, figures in scores.items()]
    return [["setting", *(": ".join(column) for column in columns)], *rows]


def number(value: Any) -> str:
    """Four decimals, "-" for NaN; counts as they are."""
    if isinstance(value, int):
        return str(value)
    return "-" if math.isnan(value) else f"{value:.4f}"


def markdown(cells: Sequence[Sequence[str]]) -> str:
    """A Markdown table, first column left, the others right."""
    rule = ["---", *["---:"] * (len(cells[0]) - 1)]
    return "".join("| " + " | ".join(row) + " |\n" for row in (cells[0], rule, *cells[1:]))
