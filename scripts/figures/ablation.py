#!/usr/bin/env python3
"""Draw docs/pictures/ablation.png from docs/ablation.csv: what each step of `default` buys on each set.

    python scripts/figures/ablation.py

A cell has the error without the step, divided by the error with it. White cells do not change.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

DOCS = Path(__file__).resolve().parents[2] / "docs"
STRONG = 3.0  # doublings of the error that have the full colour


def read_ratios(file: Path) -> tuple[list[str], list[str], np.ndarray]:
    """Return the steps, the sets with their measures, and (steps, sets) errors divided by those of the whole method."""
    with open(file, encoding="utf-8", newline="") as opened:
        rows = list(csv.DictReader(opened))
    errors = {(row["left_out"], f"{row['set']}, {row['measure']}"): float(row["error"]) for row in rows}
    sets = list(dict.fromkeys(name for _, name in errors))
    steps = [step for step in dict.fromkeys(step for step, _ in errors) if step != "nothing"]
    whole = {name: errors["nothing", name] for name in sets}
    table = [[errors.get((step, name), whole[name]) / whole[name] for name in sets] for step in steps]
    return steps, sets, np.array(table)


def draw(steps: list[str], sets: list[str], ratios: np.ndarray) -> Figure:
    figure = Figure(figsize=(11, 6), layout="constrained")
    axes = figure.subplots()
    axes.imshow(np.log2(ratios), cmap="RdBu_r", vmin=-STRONG, vmax=STRONG, aspect="auto")
    axes.set_xticks(range(len(sets)), sets, rotation=40, ha="right", fontsize=8)
    axes.set_yticks(range(len(steps)), steps, fontsize=8)
    for (row, column), ratio in np.ndenumerate(ratios):
        if abs(ratio - 1) >= 0.005:
            color = "white" if abs(np.log2(ratio)) > STRONG / 2 else "black"
            axes.text(column, row, f"{ratio:.3g}", ha="center", va="center", fontsize=7, color=color)
    axes.set_title("Error without a step, divided by the error with it", fontsize=10)
    return figure


if __name__ == "__main__":
    picture = DOCS / "pictures" / "ablation.png"
    draw(*read_ratios(DOCS / "ablation.csv")).savefig(picture, dpi=110)
    print(picture)
