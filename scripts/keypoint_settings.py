#!/usr/bin/env python3
"""Settings of CorrelationFlow-Keypoints on a fixed synthetic set: patch size L, ratio rho, gate, options.

  python scripts/keypoint_settings.py                                  the whole table, one change at a time
  python scripts/keypoint_settings.py --grid patch_size=7,11,15 ratio_threshold=1.02,1.05,1.1     a full grid

Prints Markdown: dynamic bucket-normalised error per class, EPE of moving points and of the background, and the median
time of a window as a ratio to the first row's. The seeds of the drives are used for nothing else.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
from typing import Any, Dict, List, Tuple

import numpy as np
import yaml
from tqdm import tqdm

from cflow_torch import Window, make_config, make_model
from cflow_torch.config import PRESETS
from cflow_torch.data.log import FlowLabels, window
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.simulator import make_drive

SEEDS = tuple(range(200, 210))
WINDOWS_PER_DRIVE = 4
CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")

SWEPT = ("densify", "patch_size", "ratio_threshold", "gate_radius", "second_best_distance", "mutual_check")

Item = Tuple[Window, FlowLabels]
Row = Dict[str, Any]


def load() -> List[Item]:
    """Every other pair of the drives."""
    items = []
    for seed in SEEDS:
        drive = make_drive(seed=seed, num_sweeps=2 * WINDOWS_PER_DRIVE)
        for index in range(0, 2 * WINDOWS_PER_DRIVE, 2):
            labels = drive.labels(index)
            if labels is not None:
                items.append((window(drive, index, 0), labels))
    return items


def score(items: List[Item], settings: Dict[str, Any]) -> Dict[str, float]:
    """Figures of one setting over all windows."""
    model = make_model(make_config("paper", **{"method": "keypoints", **settings}))
    metrics, seconds = SceneFlowMetrics("opensceneflow"), []
    for pair, labels in items:
        start = time.perf_counter()
        (result,) = model([pair])
        seconds.append(time.perf_counter() - start)
        metrics.update(EvalFrame.from_result(pair, result, labels))
    results = metrics.compute()
    row = {name: results["bucketed"]["classes"][name]["dynamic_error"] for name in CLASSES}
    row["mean"] = results["bucketed"]["mean"]["dynamic_error"]
    row["EPE FD"], row["EPE BS"] = results["three_way"]["epe_fd"], results["three_way"]["epe_bs"]
    row["seconds"] = statistics.median(seconds)
    return row


def one_at_a_time(chosen: Row) -> List[Row]:
    """The dense method, the chosen settings, then each of them changed alone."""
    chosen = {**{name: PRESETS["keypoints"][name] for name in PRESETS["keypoints"] if name in SWEPT}, **chosen}
    changes: Dict[str, Tuple[Any, ...]] = {
        "densify": ("components", "clusters", "nearest"),
        "patch_size": (7, 11, 15, 21, 31, 41, 51),
        "ratio_threshold": (1.0, 1.02, 1.05, 1.1, 1.2, 1.3),
        "gate_radius": (1.5, 2.0, 2.5, 3.0, 4.0),
        "second_best_distance": (0.0, 2.0, 3.0, 5.0),
        "mutual_check": (False, True),
    }
    return [
        {"method": "dense"},
        chosen,
        *({**chosen, name: value} for name, values in changes.items() for value in values),
    ]


def parse(settings: List[str]) -> Dict[str, List[Any]]:
    """["a=1,2", "b=x"] -> {"a": [1, 2], "b": ["x"]}."""
    pairs = (setting.split("=", 1) for setting in settings)
    return {name: [yaml.safe_load(value) for value in values.split(",")] for name, values in pairs}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grid", nargs="+", metavar="NAME=V,V", help="all combinations of these values")
    parser.add_argument(
        "--base",
        nargs="*",
        default=[],
        metavar="NAME=V",
        help="what differs from the preset (with --grid: from `paper`)",
    )
    arguments = parser.parse_args()
    base = {name: values[0] for name, values in parse(arguments.base).items()}
    rows = one_at_a_time(base)
    if arguments.grid:
        grid = parse(arguments.grid)
        rows = [{**base, **dict(zip(grid, values))} for values in itertools.product(*grid.values())]
    items = load()
    names = sorted({name for row in rows for name in row})
    print(f"{len(items)} windows; classes: dynamic bucket-normalised error; EPE in metres; base: {base or 'preset'}\n")
    first = None
    for row in tqdm(rows, unit="setting"):
        figures = score(items, row)
        if first is None:
            first = figures["seconds"]
            header = [*names, *list(figures)[:-1], "time"]
            print("| " + " | ".join(header) + " |\n" + "|---" * len(header) + "|")
        values = [figures[name] for name in list(figures)[:-1]]
        cells = [str(row.get(name, "")) for name in names]
        cells += ["-" if np.isnan(value) else f"{value:.4f}" for value in values] + [
            f"{figures['seconds'] / first:.2f}"
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
