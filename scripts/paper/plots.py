"""Draw the paper's figures and ours next to them, in the paper's colours and markers."""

from __future__ import annotations

import math
from typing import Any, List, Mapping, Sequence, Tuple

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from results import CLASSES, METHODS, Ours, Run, protocol, range_errors

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
PAPER_SET = "paper, Argoverse 2 val"
Panels = List[Tuple[str, Mapping[str, Sequence[float]]]]  # title, and values by line or bar


def draw(name: str, paper: dict[str, Any], ours: Ours) -> Figure:
    """Draw the figure of an experiment: the paper's numbers, of figures.yaml, next to ours, which may have gaps."""
    at, panels = paper["at"], _panels(name, paper, ours)
    if name == "datasets":
        return _bars(panels, at, ["Overall", *ours])
    columns = {"history": len(panels), "scales": len(SHOWN), "range_split": math.ceil(len(panels) / 2)}[name]
    rows = math.ceil(len(panels) / columns)
    errors = [v for _, lines in panels for values in lines.values() for v in values if not math.isnan(v)]
    figure = Figure(figsize=(min(13.0, 4.8 * columns), 3.6 * rows), layout="constrained")
    all_axes: list[Axes] = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    for axes, (title, lines) in zip(all_axes, panels):
        for label, values in lines.items():
            axes.plot(range(len(at)), values, label=label, clip_on=False, **STYLES[label])
        axes.set(title=title, xticks=range(len(at)), xticklabels=at, xlabel=paper.get("x", "metres"))
        axes.set_ylim(0, 1.05 * max(0.38, *errors))
        axes.grid(axis="y", linestyle="--", alpha=0.6)
    for axes in all_axes[::columns]:
        axes.set_ylabel(ERROR)
    for axes in all_axes[len(panels) :]:
        axes.set_axis_off()
    figure.legend(*all_axes[0].get_legend_handles_labels(), ncols=4, loc="outside upper center", fontsize=9)
    return figure


def _panels(name: str, paper: dict[str, Any], ours: Ours) -> Panels:
    """Title and lines of each panel: the paper's first, then those of our data sets."""
    if name == "history":
        rows = [f"h={h}" for h in paper["at"]]
        mine = [(data_set, {c: _of_class(runs, rows, c) for c in SHOWN}) for data_set, runs in ours.items()]
        return [(PAPER_SET, {c: paper["lines"][c] for c in SHOWN}), *mine]
    if name == "scales":
        panels: Panels = [(f"{PAPER_SET}: {c}", paper["panels"][c]) for c in SHOWN]
        for data_set, runs in ours.items():
            for c in SHOWN:
                lines = {h: _of_class(runs, [f"{h}, {n} scales" for n in paper["at"]], c) for h in paper["panels"][c]}
                panels.append((f"{data_set}: {c}", lines))
        return panels
    if name == "datasets":
        bars = {method: [s.overall, *(s.data_sets[d] for d in ours)] for method, s in protocol(ours).items()}
        return [("paper, test set of the 2026 challenge", paper["bars"]), *([("this package", bars)] if bars else [])]
    mine = [(d, {m: range_errors(runs[m]) for m in METHODS.values() if m in runs}) for d, runs in ours.items()]
    return [*((f"{data_set} (paper)", lines) for data_set, lines in paper["panels"].items()), *mine]


def _of_class(runs: Mapping[str, Run], rows: Sequence[str], which: str) -> list[float]:
    """Error of one class in some rows, NaN where a run is missing."""
    at = list(CLASSES).index(which)
    return [runs[row].values()[at] if row in runs else math.nan for row in rows]


def _bars(panels: Panels, *groups: Sequence[str]) -> Figure:
    """Bars with a group per data set and a bar per method; all panels have bars of one width."""
    figure = Figure(figsize=(12, 3.9 * len(panels)), layout="constrained")
    width = 0.1
    for axes, (title, bars), names in zip(figure.subplots(len(panels), 1, squeeze=False)[:, 0], panels, groups):
        for number, (method, values) in enumerate(bars.items()):
            shift = (number - (len(bars) - 1) / 2) * width
            positions = [group + shift for group in range(len(names))]
            axes.bar(positions, values, width * 0.95, label=method, color=STYLES[method]["color"])
        axes.set(title=title, xticks=range(len(names)), xticklabels=names, ylabel=ERROR)
        axes.set(xlim=(-0.6, max(map(len, groups)) - 0.4), ylim=(0.1, None))  # from 0.1, as in the paper
        axes.grid(axis="y", linestyle="--", alpha=0.4)
        axes.set_axisbelow(True)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), ncols=8, loc="outside upper center", fontsize=8)
    return figure
