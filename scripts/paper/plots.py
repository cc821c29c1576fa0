"""Draw the paper's figures and ours next to them, in the paper's colours and markers."""

from __future__ import annotations

import math
from typing import Any, Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from results import CLASSES, METHODS, Ours, Run, protocol, range_errors

ERROR = "Dynamic Bucket-Normalized EPE"
TITLES = {"CAR": "Car", "PED": "Pedestrian", "VRU": "VRU", "OTHER": "Other"}
CLASS_STYLE = {
    "CAR": {"color": "blue", "marker": "o"},
    "PED": {"color": "green", "marker": "^"},
    "VRU": {"color": "orange", "marker": "D"},
    "OTHER": {"color": "red", "marker": "s"},
}
HISTORY_STYLE = {
    "h=0": {"color": "blue", "marker": "o"},
    "h=2": {"color": "red", "marker": "s"},
    "h=4": {"color": "green", "marker": "^"},
}
METHOD_STYLE = {
    "CorrelationFlow": {"color": "#0000ff", "marker": "o"},
    "SSF": {"color": "#ff0000", "marker": "s"},
    "CorrelationFlow-Keypoint": {"color": "#00c800", "marker": "^"},
    "RVLoss": {"color": "#ffa500", "marker": "D"},
    "TeFlow": {"color": "#800080", "marker": "p"},
    "SeFlow++": {"color": "#ffc0cb", "marker": "o"},
    "VoteFlow": {"color": "#008080", "marker": "x"},
    "SeFlow": {"color": "#4b0082", "marker": "+"},
}
PAPER_SET = "paper, Argoverse 2 val"


def draw(name: str, paper: dict[str, Any], ours: Ours) -> Figure:
    """Draw the figure of an experiment.

    Args:
        name: history, scales, datasets or range_split.
        paper: the paper's numbers, an entry of figures.yaml.
        ours: data set -> row -> run; may be empty or have gaps.
    """
    figures = {"history": _history, "scales": _scales, "datasets": _datasets, "range_split": _range_split}
    return figures[name](paper, ours)


def _of_class(runs: Mapping[str, Run], rows: Sequence[str], which: str) -> list[float]:
    """Error of one class in some rows, NaN where a run is missing."""
    at = list(CLASSES).index(which)
    return [runs[row].values()[at] if row in runs else math.nan for row in rows]


def _history(paper: dict[str, Any], ours: Ours) -> Figure:
    """Error over h with a line per class: the paper's panel, then a panel per data set."""
    figure = Figure(figsize=(5.2 * (1 + len(ours)), 4.0), layout="constrained")
    panels = figure.subplots(1, 1 + len(ours), sharey=True, squeeze=False)[0]
    rows = [f"h={h}" for h in paper["at"]]
    lines = {PAPER_SET: paper["lines"]}
    for data_set, runs in ours.items():
        lines[data_set] = {which: _of_class(runs, rows, which) for which in CLASSES}
    for axes, (title, of_class) in zip(panels, lines.items()):
        for which, style in CLASS_STYLE.items():
            axes.plot(paper["at"], of_class[which], label=TITLES[which], clip_on=False, **style)
        axes.set(title=title, xlabel=paper["x"], xticks=paper["at"], xlim=(0, 9))
        _grid(axes)
    panels[0].set_ylabel(ERROR)
    figure.legend(*panels[0].get_legend_handles_labels(), ncols=4, loc="outside upper center")
    _error_axis(panels, top=0.4)
    return figure


def _scales(paper: dict[str, Any], ours: Ours) -> Figure:
    """Error over the number of scales with a line per h: a row of four classes for the paper and for each data set."""
    figure = Figure(figsize=(13, 3.3 * (1 + len(ours))), layout="constrained")
    grid = figure.subplots(1 + len(ours), 4, squeeze=False)
    for panels, (title, runs) in zip(grid, [(PAPER_SET, {}), *ours.items()]):
        for axes, which in zip(panels, TITLES):
            for h, style in HISTORY_STYLE.items():
                if title == PAPER_SET:
                    values = paper["panels"][which][h]
                else:
                    values = _of_class(runs, [f"{h}, {n} scales" for n in paper["at"]], which)
                axes.plot(paper["at"], values, label=f"${h}$", clip_on=False, **style)
            axes.set(title=TITLES[which], xticks=paper["at"], xlim=(1, 5))
            _grid(axes)
        panels[0].set_ylabel(f"{title}\n{ERROR}", fontsize=8)
        _error_axis(panels, top=0.4)
    for axes in grid[-1]:
        axes.set_xlabel(paper["x"])
    figure.legend(*grid[0, 0].get_legend_handles_labels(), ncols=3, loc="outside upper center")
    return figure


def _datasets(paper: dict[str, Any], ours: Ours) -> Figure:
    """Bars with a group per data set and a bar per method; below, our two variants on our data sets."""
    scores = protocol(ours)
    rows = 2 if scores else 1
    figure = Figure(figsize=(12, 3.9 * rows), layout="constrained")
    panels = figure.subplots(rows, 1, squeeze=False)[:, 0]
    _bars(panels[0], paper["at"], paper["bars"])
    panels[0].set_title("paper, test set of the 2026 challenge", fontsize=9)
    figure.legend(*panels[0].get_legend_handles_labels(), ncols=8, loc="outside upper center", fontsize=8)
    if scores:
        groups = ["Overall", *ours]
        _bars(panels[1], groups, {m: [s.overall, *(s.data_sets[d] for d in ours)] for m, s in scores.items()})
        panels[1].set_title("this package", fontsize=9)
        panels[1].set_xlim(panels[0].get_xlim() if len(groups) <= len(paper["at"]) else None)  # bars of equal width
    return figure


def _bars(axes: Axes, groups: Sequence[str], bars: Mapping[str, Sequence[float]]) -> None:
    width = 0.1
    for number, (method, values) in enumerate(bars.items()):
        shift = (number - (len(bars) - 1) / 2) * width
        positions = [group + shift for group in range(len(groups))]
        axes.bar(positions, values, width * 0.95, label=method, color=METHOD_STYLE[method]["color"])
    axes.set(xticks=range(len(groups)), xticklabels=groups, ylabel=ERROR, xlim=(-0.6, len(groups) - 0.4))
    highest = max((v for values in bars.values() for v in values if not math.isnan(v)), default=0.0)
    axes.set_ylim(0.1, max(0.92, highest * 1.05))  # from 0.1, as in the paper
    if highest < 1:
        axes.set_yticks([0.1, 0.3, 0.5, 0.7, 0.9])
    axes.grid(axis="y", linestyle="--", alpha=0.4)
    axes.set_axisbelow(True)


def _range_split(paper: dict[str, Any], ours: Ours) -> Figure:
    """Error at short and long range: the paper's 2 x 2 panels, and ours in further columns."""
    panels = [(f"{name} (paper)", lines) for name, lines in paper["panels"].items()]
    for data_set, runs in ours.items():
        panels.append((data_set, {m: range_errors(runs[m]) for m in METHODS.values() if m in runs}))
    columns = 2 + math.ceil(len(ours) / 2)
    figure = Figure(figsize=(4.2 * columns, 7.5), layout="constrained")
    grid = figure.subplots(2, columns, squeeze=False)
    all_axes = [grid[row, column] for row in range(2) for column in range(2)]  # AEVA, AV2 above TruckScene, Waymo
    all_axes += [grid[row, column] for column in range(2, columns) for row in range(2)]
    for axes, (title, lines) in zip(all_axes, panels):
        for method, values in lines.items():
            style = dict(METHOD_STYLE[method])
            if method == "SeFlow++":
                style["markerfacecolor"] = "none"
            axes.plot([0, 1], values, label=method, markersize=8, **style)
        axes.set(title=title, xticks=[0, 1], xticklabels=[f"{name}m" for name in paper["at"]], xlim=(-0.1, 1.1))
        _error_axis([axes], bottom=0.1, top=0.9)
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_ylabel(ERROR)
    figure.legend(*all_axes[0].get_legend_handles_labels(), ncols=4, loc="outside upper center", fontsize=9)
    return figure


def _grid(axes: Axes) -> None:
    axes.grid(axis="y", linestyle="--", alpha=0.6)


def _error_axis(panels: Sequence[Axes], top: float, bottom: float = 0.0) -> None:
    """Set one range of errors for all panels: the paper's range, extended where a value would be outside."""
    limits = [axes.dataLim.intervaly for axes in panels]
    high = max([top, *(limit[1] * 1.05 for limit in limits if math.isfinite(limit[1]))])
    low = min([bottom, *(limit[0] * 0.95 for limit in limits if math.isfinite(limit[0]))])
    for axes in panels:
        axes.set_ylim(low, high)
