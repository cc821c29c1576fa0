"""Time of settings over that of the paper's method at equal history, region and scales, measured in turn."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Callable, Dict, List, Sequence

import torch
from beyond_rows import PAPER, Setting
from beyond_sets import ScoredSet
from beyond_tables import Cells

from cflow_torch import make_model
from cflow_torch.bench.machine import describe_machine
from cflow_torch.bench.timing import alternate, median_ratio, threads

WINDOWS = 4  # of each set, the last ones


@dataclass(frozen=True)
class Timed:
    """One setting on one set.

    Args:
        set_name, setting: what was measured.
        paper_s, seconds: per round, all windows; the paper's preset at equal history, region and scales, and ours.
    """

    set_name: str
    setting: str
    paper_s: List[float]
    seconds: List[float]

    def median(self) -> float:
        """Median over the rounds of ours over the paper's."""
        return median_ratio(self.paper_s, self.seconds)

    def least(self) -> float:
        """Our fastest round over the paper's fastest."""
        return min(self.seconds) / min(self.paper_s)


def measure(sets: Sequence[ScoredSet], settings: Sequence[Setting], rounds: int, num_threads: int) -> List[Timed]:
    """Every setting beside the paper's method, in one process, round by round in turn."""
    timed = []
    for scored in sets:
        windows = [item.window for item in scored.items()[-WINDOWS:]]
        configs, names = [], []
        for setting in settings:
            config = setting.for_set(scored)
            paper = PAPER.but("paper", pixel_sizes=config.pixel_sizes).for_set(scored)
            configs += [paper, config]
            names.append(setting.name)
        distinct = list(dict.fromkeys(configs))
        models = [make_model(config) for config in distinct]

        def run(model: Any) -> Callable[[], None]:
            return lambda: [model([w]) for w in windows] and None  # noqa: B023

        with threads(num_threads):
            seconds = dict(zip(distinct, alternate([run(model) for model in models], rounds)))
        for number, name in enumerate(names):
            paper, config = configs[2 * number : 2 * number + 2]
            timed.append(Timed(scored.name, name, seconds[paper], seconds[config]))
    return timed


def time_cells(timed: Sequence[Timed]) -> Cells:
    """Header and rows: median and least ratio, a row per set, two columns per setting."""
    settings = list(dict.fromkeys(t.setting for t in timed))
    cells = [["set", *(f"`{name}`: {what}" for name in settings for what in ("median", "minimum"))]]
    for set_name in dict.fromkeys(t.set_name for t in timed):
        of_set = {t.setting: t for t in timed if t.set_name == set_name}
        ratios = [ratio for name in settings for ratio in (of_set[name].median(), of_set[name].least())]
        cells.append([set_name, *(f"{ratio:.2f}" for ratio in ratios)])
    return cells


def record(timed: Sequence[Timed], num_threads: int) -> Dict[str, Any]:
    """What was measured, ready for JSON."""
    return {
        "machine": describe_machine(num_threads, torch.device("cpu")),
        "windows_per_round": WINDOWS,
        "times": [vars(t) for t in timed],
    }
