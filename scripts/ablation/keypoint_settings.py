#!/usr/bin/env python3
"""Settings of CorrelationFlow-Keypoints on a fixed simulated set: patch size L, ratio rho, gate, densification.

  python scripts/ablation/keypoint_settings.py                        the whole table, one change at a time
  python scripts/ablation/keypoint_settings.py --grid patch_size=7,11,15 ratio_threshold=1.02,1.1     a full grid

Prints Markdown: dynamic bucket-normalised error per class, EPE of moving points and of the background, and the median
time of a window as a ratio to the first row's. The seeds of the drives are used for nothing else.
"""

from __future__ import annotations

import argparse
import itertools
from typing import Any, Dict, List, Tuple

import torch
import yaml
from report import markdown, number
from score import CLASSES
from tqdm import tqdm

from cflow_torch import Window, make_config, make_model
from cflow_torch.config import PRESETS
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.simulator import make_drive
from cflow_torch.stages import StopWatch

SEEDS = tuple(range(200, 210))
WINDOWS_PER_DRIVE = 4
CHANGES: Dict[str, Tuple[Any, ...]] = {
    "densify": ("components", "clusters", "nearest"),
    "patch_size": (7, 11, 15, 21, 31, 41, 51),
    "ratio_threshold": (1.0, 1.02, 1.05, 1.1, 1.2, 1.3),
    "gate_radius": (1.5, 2.0, 2.5, 3.0, 4.0),
}
Row = Dict[str, Any]


def load() -> List[Tuple[Window, FlowLabels]]:
    """Every other pair of the drives."""
    items = []
    for seed in SEEDS:
        drive = make_drive(seed=seed, num_sweeps=2 * WINDOWS_PER_DRIVE)
        items += [(window(drive, i, 0), drive.labels(i)) for i in range(0, 2 * WINDOWS_PER_DRIVE, 2)]
    return items


def score(items: List[Tuple[Window, FlowLabels]], settings: Row) -> Dict[str, float]:
    """Figures of one setting over all windows, "seconds" the last."""
    model = StopWatch(make_model(make_config("paper", **{"method": "keypoints", **settings})))
    metrics = SceneFlowMetrics("opensceneflow")
    for pair, labels in items:
        metrics.update(EvalFrame.from_result(pair, model([pair])[0], labels))
    results = metrics.compute()
    row = {name: results["bucketed"]["classes"][name]["dynamic_error"] for name in CLASSES}
    row["mean"] = results["bucketed"]["mean"]["dynamic_error"]
    row["EPE FD"], row["EPE BS"] = results["three_way"]["epe_fd"], results["three_way"]["epe_bs"]
    row["seconds"] = model.report()["median"]
    return row


def one_at_a_time(base: Row) -> List[Row]:
    """The dense method, the preset with the changes of `base`, then each setting changed alone."""
    chosen = {**{name: value for name, value in PRESETS["keypoints"][1].items() if name in CHANGES}, **base}
    changed = [{**chosen, name: value} for name, values in CHANGES.items() for value in values]
    return [{"method": "dense"}, chosen, *changed]


def parse(settings: List[str]) -> Dict[str, List[Any]]:
    """["a=1,2", "b=x"] -> {"a": [1, 2], "b": ["x"]}."""
    pairs = (setting.split("=", 1) for setting in settings)
    return {name: [yaml.safe_load(value) for value in values.split(",")] for name, values in pairs}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grid", nargs="+", default=[], metavar="NAME=V,V", help="all combinations of these values")
    about_base = "what differs from the preset (with --grid: from `paper`)"
    parser.add_argument("--base", nargs="*", default=[], metavar="NAME=V", help=about_base)
    given = parser.parse_args()
    torch.set_num_threads(1)
    base, grid = {name: values[0] for name, values in parse(given.base).items()}, parse(given.grid)
    rows = [{**base, **dict(zip(grid, values))} for values in itertools.product(*grid.values())]
    items, cells, first = load(), [], None
    rows = rows if grid else one_at_a_time(base)
    names = sorted({name for row in rows for name in row})
    for row in tqdm(rows, unit="setting"):
        figures = score(items, row)
        seconds = figures.pop("seconds")
        first = first or seconds
        cells.append(
            [*(str(row.get(name, "")) for name in names), *map(number, figures.values()), number(seconds / first)]
        )
    print(f"{len(items)} windows; dynamic bucket-normalised error of classes; EPE in metres\n")
    print(markdown([[*names, *figures, "time"], *cells]))


if __name__ == "__main__":
    main()
