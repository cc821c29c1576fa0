"""Target table, classes, sensors and ablation as Markdown and CSV."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Dict, List, Mapping, Optional, Sequence

import numpy as np
from beyond_score import CLASSES, Figures, merge_classes
from beyond_sets import PROFILES

from cflow_torch.evaluation.bucketed import mean_of_present

Cells = List[List[str]]
Scores = Dict[str, Figures]  # by name of the set
DEFAULT, FAST = "default", "fast"


@dataclass(frozen=True)
class Target:
    """One line of the target table.

    Args:
        text: what is measured.
        set_name: of a set, or of the mean over sensors ("sim 100-103 h=4").
        figure: key of its figures.
        wanted: largest value; with `is_share` largest ratio to the paper preset. None = shown only.
    """

    text: str
    set_name: str
    figure: str
    wanted: Optional[float] = None
    is_share: bool = False


def _real(text: str, name: str, dynamic: Optional[float], static: Optional[float]) -> List[Target]:
    return [
        Target(f"{text}: dynamic, m", name, "dynamic", dynamic),
        Target(f"{text}: static, m", name, "static", static),
    ]


REAL_TARGETS: List[Target] = [
    *_real("Argoverse 2 pair", "av2 pair h=0", 0.037, 0.001),
    *_real("KITTI, h = 0", "kitti h=0", 0.034, 0.005),
    Target("KITTI, h = 0: pedestrian, error / speed", "kitti h=0", "pedestrian", 0.27),
    *_real("KITTI, h = 4", "kitti h=4", 0.025, 0.005),
    *_real("KITTI, every third sweep", "third sweeps h=0", 0.065, 0.010),
    *_real("KITTI, every fifth sweep", "fifth sweeps h=0", 0.095, 0.006),
    *_real("merge set", "merge h=0", 0.045, None),
    *_real("odd starts, h = 4", "kitti odd h=4", None, None),
    *_real("odd starts, every third sweep", "third sweeps odd h=0", None, None),
    *_real("odd starts, every fifth sweep", "fifth sweeps odd h=0", None, None),
]


def simulated_targets(name: str) -> List[Target]:
    """Targets on the mean over the sensors of one range of seeds."""
    return [
        Target(f"{name}: dynamic, 0-35 m", name, "near", 0.60, True),
        Target(f"{name}: dynamic, 35-70 m", name, "far", 0.75, True),
        Target(f"{name}: static, m", name, "static", 0.30, True),
        Target(f"{name}: static, 35-70 m, m", name, "far_static"),
        *(Target(f"{name}: {c}, 0-35 m", name, f"near {c}", 1.0, True) for c in CLASSES),
        *(Target(f"{name}: {c}, 35-70 m", name, f"far {c}") for c in CLASSES),
    ]


def simulated_names(scores: Scores) -> List[str]:
    """ "sim 100-103 h=4" ... of the sets of five sensors among these."""
    return list(dict.fromkeys(_mean_name(name) for name in scores if _is_of_sensor(name)))


def with_means(scores: Scores) -> Scores:
    """The same and, per range of seeds and h, the means over the sensors; classes over all points of all sensors."""
    result = dict(scores)
    for mean_name in simulated_names(scores):
        parts = [part for name, part in scores.items() if _is_of_sensor(name) and _mean_name(name) == mean_name]
        keys = ("near", "far", "static", "far_static", "dynamic")
        mean: Figures = {key: mean_of_present(np.array([part[key] for part in parts])) for key in keys}
        for name, classes in merge_classes(parts).items():
            mean.update({f"{name} {c}": value for c, value in classes.items()})
        result[mean_name] = mean
    return result


def target_cells(scores: Mapping[str, Scores]) -> Cells:
    """Header and rows: paper, wanted, got. `scores`: by setting, with means."""
    names = list(scores)
    base = [name for name in names if name not in (DEFAULT, FAST)]
    cells = [["", *(f"`{name}`" for name in base), "wanted", "`default`", "met", "`fast`"]]
    targets = [t for t in REAL_TARGETS if t.set_name in scores[DEFAULT]]
    for name in simulated_names(scores[DEFAULT]):
        targets += simulated_targets(name)
    for target in targets:
        values = {name: scores[name][target.set_name][target.figure] for name in names}
        got = values[DEFAULT]
        row = [target.text, *(number(values[name]) for name in base)]
        if target.is_share:
            # Wanted of the better of the two; changes against both are told.
            limit = target.wanted * min(values[name] for name in base)
            less = f"at most {target.wanted:g} x" if target.wanted != 1 else "no worse"
            change = " / ".join(f"{100 * (got / values[name] - 1):+.0f} %" for name in base)
            row += [less, f"{number(got)} ({change})", "yes" if got <= limit else "**no**"]
        else:
            met = "" if target.wanted is None else "yes" if got <= target.wanted else "**no**"
            row += ["" if target.wanted is None else f"{target.wanted:g}", number(got), met]
        cells.append([*row, number(values[FAST])])
    return cells


def sensor_cells(scores: Mapping[str, Scores]) -> Cells:
    """Header and rows: near, far, static and near classes of every sensor, a row per setting."""
    cells = [["seeds, h", "sensor", "setting", "0-35 m", "35-70 m", "static, m", *CLASSES]]
    for name in filter(_is_of_sensor, next(iter(scores.values()))):
        profile = name.split()[1]
        for setting, figures in scores.items():
            part = figures[name]
            values = [part["near"], part["far"], part["static"], *(part["near_classes"][c] for c in CLASSES)]
            cells.append([_mean_name(name)[4:], profile, f"`{setting}`", *map(number, values)])
    return cells


def ablation_cells(scores: Mapping[str, Scores]) -> Cells:
    """Header and rows: a column per set, dynamic / static; KITTI h = 0 with pedestrians, sim near / far / static."""
    first = next(iter(scores.values()))
    real = [name for name in first if not name.startswith("sim ")]
    means = simulated_names(first)
    cells = [["", *real, *means, *(f"{name}: CAR OTHER PED WHEELED" for name in means)]]
    for setting, figures in scores.items():
        row = [setting]
        for name in real:
            part = figures[name]
            values = [part["dynamic"], part["static"]]
            if name == "kitti h=0":
                values.insert(1, part["pedestrian"])
            row.append(" / ".join(map(number, values)))
        keys = ("near", "far", "static")
        row += [" / ".join(number(figures[name][key]) for key in keys) for name in means]
        row += [" ".join(number(figures[name][f"near {c}"]) for c in CLASSES) for name in means]
        cells.append(row)
    return cells


def flat_cells(scores: Mapping[str, Scores]) -> Cells:
    """Header and rows: a column per figure, for programs."""
    columns = []
    for set_name, part in next(iter(scores.values())).items():
        columns += [(set_name, key) for key, value in part.items() if isinstance(value, (int, float))]
    rows = [[name, *(number(f[set_name][key]) for set_name, key in columns)] for name, f in scores.items()]
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


def _is_of_sensor(name: str) -> bool:
    return name.startswith("sim ") and name.split()[1] in PROFILES


def _mean_name(name: str) -> str:
    """ "sim waymo 100-103 h=4" -> "sim 100-103 h=4"."""
    words = name.split()
    return " ".join([words[0], *words[2:]])
