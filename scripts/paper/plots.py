"""Draw the paper's figures and ours next to them, in the paper's colours and markers."""

from __future__ import annotations

import math
from typing import Any, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from results import Line

ERROR = "Dynamic Bucket-Normalized EPE"
STYLES = {
    "CAR": {"color": "blue", "marker": "o"},
    "PED": {"color": "green", "marker": "^"},
    "VRU": {"color": "orange", "marker": "D"},
    "OTHER": {"color": "red", "marker": "s"},
    "h=0": {"color": "blue", "marker": "o"},
    "h=2": {"color": "red", "marker": "s"},
    "h=4": {"color": "green", "marker": "^"},
    "CorrelationFlow": {"color": "#0000ff", "marker": "o"},
    "SSF": {"color": "#ff0000", "marker": "s"},
    "CorrelationFlow-Keypoint": {"color": "#00c800", "marker": "^"},
    "RVLoss": {"color": "#ffa500", "marker": "D"},
    "TeFlow": {"color": "#800080", "marker": "p"},
    "SeFlow++": {"color": "#ffc0cb", "marker": "o", "markerfacecolor": "none"},
    "VoteFlow": {"color": "#008080", "marker": "x"},
    "SeFlow": {"color": "#4b0082", "marker": "+"},
}
SHOWN = ("CAR", "PED", "VRU", "OTHER")  # classes in the paper's order


def draw(name: str, about: dict[str, Any], lines: Sequence[Line]) -> Figure:
    """Draw the figure of an experiment: the paper's numbers next to ours, which may have gaps."""
    if name == "datasets":
        return _bars(lines)
    at, panels = about["at"], _panels(name, about, lines)
    columns = {"history": len(panels), "scales": len(SHOWN), "range_split": math.ceil(len(panels) / 2)}[name]
    rows = math.ceil(len(panels) / columns)
    errors = [v for curves in panels.values() for values in curves.values() for v in values if not math.isnan(v)]
    figure = Figure(figsize=(min(13.0, 4.8 * columns), 3.6 * rows), layout="constrained")
    all_axes: list[Axes] = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for axes, (title, curves) in zip(all_axes, panels.items()):
        for label, values in curves.items():
            axes.plot(range(len(at)), values, label=label, clip_on=False, **STYLES[label])
        axes.set(title=title, xticks=range(len(at)), xticklabels=at, xlabel=about["x"])
        axes.set_ylim(0, 1.05 * max(0.38, *errors))
        axes.grid(axis="y", linestyle="--", alpha=0.6)
    for axes in all_axes[::columns]:
        axes.set_ylabel(ERROR)
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    figure.legend(*all_axes[0].get_legend_handles_labels(), ncols=4, loc="outside upper center", fontsize=9)
    return figure


def _panels(name: str, about: dict[str, Any], lines: Sequence[Line]) -> dict[str, dict[str, list[float]]]:
    """Panel -> curve -> numbers: the paper's panels first, then those of our data sets."""
    panels: dict[str, dict[str, list[float]]] = {}
    for row, origin, numbers in lines:
        title = "paper, Argoverse 2 val" if origin == "paper" else origin
        if name == "range_split":
            data_set = row.rsplit(" ", 2)[0]
            title = f"{data_set} (paper)" if origin == "paper" else data_set
        elif row not in about["rows"]:
            continue
        for column in about.get("columns", SHOWN):
            panel, curve = (f"{title}: {column}", row.split(",")[0]) if name == "scales" else (title, column)
            panels.setdefault(panel, {}).setdefault(curve, []).append(numbers.get(column, math.nan))
    return panels


def _bars(lines: Sequence[Line]) -> Figure:
    """Bars with a group per data set and a bar per method; all panels have bars of one width."""
    titles = {"paper": "paper, test set of the 2026 challenge", "ours": "this package"}
    groups = {origin: {row: numbers for row, of, numbers in lines if of == origin} for origin in titles}
    groups = {origin: rows for origin, rows in groups.items() if rows}
    figure = Figure(figsize=(12, 3.9 * len(groups)), layout="constrained")
    width = 0.1
    for axes, (origin, rows) in zip(figure.subplots(len(groups), 1, squeeze=False)[:, 0], groups.items()):
        methods = list(next(iter(rows.values())))
        for number, method in enumerate(methods):
            shift = (number - (len(methods) - 1) / 2) * width
            positions = [group + shift for group in range(len(rows))]
            values = [numbers[method] for numbers in rows.values()]
            axes.bar(positions, values, width * 0.95, label=method, color=STYLES[method]["color"])
        axes.set(title=titles[origin], xticks=range(len(rows)), xticklabels=list(rows), ylabel=ERROR)
        axes.set(xlim=(-0.6, max(map(len, groups.values())) - 0.4), ylim=(0.1, None))  # from 0.1, as in the paper
        axes.grid(axis="y", linestyle="--", alpha=0.4)
        axes.set_axisbelow(True)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), ncols=8, loc="outside upper center", fontsize=8)
    return figure
