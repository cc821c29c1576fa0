#!/usr/bin/env python3
"""Compare presets and settings on real and simulated sets (sets.py), in one Markdown table.

  python scripts/ablation/run.py --presets paper default --sets real merged
  python scripts/ablation/run.py --set --set significance=3 --set num_history=0    `default`, and two changes of it
  python scripts/ablation/run.py --sets scenes "kitti h=4"                         single sets by their names

Sets: real (CFLOW_DATA, else ../shared/data), odd (the other windows of the same KITTI drive), merged (a car under a
tree crown, a later part of KITTI), pandaset, scenes (small simulated drives, a window for each of five seeds), sim
(simulated drives of five sensors, h = 4, and their mean). We chose settings on seeds 100-103 and checked the choice on
400-403; use 300 and above for final scores only. Every setting has the history and the region of the set unless --set
changes them; scenes have the region of the preset.

Columns: end-point errors in metres over all points within 35 m ("border": 76.8 m) without ground; for scenes, means
over the drives. dynamic: objects that move by at least 0.05 m per sweep; in a scene, its scored objects. pedestrian:
error divided by speed. static: background. near, far: dynamic bucket-normalised error, mean over the classes, 0-35 m
and 35-70 m. missed: share of moving points whose flow is less than half of the true one. moving: number of moving
points. The JSON file also has near and far of each class.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from functools import partial
from pathlib import Path
from typing import Any, Callable, Mapping, Sequence

import torch
from omegaconf import OmegaConf
from score import Figures, mean_figures, score
from sets import ScoredSet, make_sets

from cflow_torch.config import make_config
from cflow_torch.data.files import write_json
from cflow_torch.types import CFlowError

COLUMNS = ("dynamic", "pedestrian", "static", "near", "far", "missed", "moving")
CACHE = Path(os.environ.get("CFLOW_CACHE") or "outputs/cache")


def main() -> int:
    """Print the table, row by row; returns the exit status."""
    parser = make_parser(__doc__, ["real", "odd", "merged"], (100, 103))
    parser.add_argument("--presets", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", action="append", metavar="NAME=VALUE", help="once a setting")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    settings = {}
    for preset in given.presets:
        for changes in [OmegaConf.to_container(OmegaConf.from_dotlist(each)) for each in given.set or [[]]]:
            name = " ".join([preset, *(f"{key}={value}" for key, value in changes.items())])
            settings[name] = partial(score_preset, preset=preset, changes=changes)
    try:
        scores = print_table(make_sets(given.sets, given.seeds, CACHE), settings)
    except CFlowError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if given.json:
        write_json(given.json, scores)
    return 0


def make_parser(description: str | None, sets: list[str], seeds: tuple[int, int]) -> argparse.ArgumentParser:
    """Return a parser that knows the choice of sets, with its defaults."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=sets, help="groups, or sets by their names")
    parser.add_argument("--seeds", nargs="+", type=seed_range, default=[seeds], metavar="FIRST-LAST")
    return parser


def seed_range(text: str) -> tuple[int, int]:
    """First and last seed of "100-103"."""
    match = re.fullmatch(r"(\d+)-(\d+)", text)
    if match is None or int(match[1]) > int(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r}: give a first and a last seed, for example 100-103")
    return int(match[1]), int(match[2])


def print_table(
    sets: Sequence[ScoredSet], settings: Mapping[str, Callable[[ScoredSet], Figures]]
) -> dict[str, dict[str, Figures]]:
    """Print a row for every setting on every set and means over sensors; return the figures by set, then by setting."""
    torch.set_num_threads(1)
    scores: dict[str, dict[str, Figures]] = {}
    sensors: dict[str, list[str]] = {}
    print(f"| set | setting | {' | '.join(COLUMNS)} |\n|{'---|' * (2 + len(COLUMNS))}", flush=True)
    for scored in sets:
        for name, score_on in settings.items():
            figures = scores.setdefault(scored.name, {})[name] = score_on(scored)
            print_row(scored.name, name, figures)
        if scored.mean:
            sensors.setdefault(scored.mean, []).append(scored.name)
    for mean, parts in sensors.items():
        for name in settings:
            figures = scores.setdefault(mean, {})[name] = mean_figures([scores[part][name] for part in parts])
            print_row(mean, name, figures)
    return scores


def print_row(of_set: str, setting: str, figures: Figures) -> None:
    """Print a row of the table; "-" for missing figures."""
    *values, moving = (figures.get(column, math.nan) for column in COLUMNS)
    shown = " | ".join("-" if math.isnan(value) else f"{value:.4f}" for value in values)
    print(f"| {of_set} | {setting} | {shown} | {moving:.0f} |", flush=True)


def score_preset(scored: ScoredSet, preset: str, changes: dict[str, Any]) -> Figures:
    """Score a preset with the history and the region of a set, for a fair comparison, and with the given changes."""
    of_set: dict[str, Any] = {"num_history": scored.history}
    if scored.half_side is not None:
        half = scored.half_side
        of_set["point_cloud_range"] = (-half, -half, -math.inf, half, half, math.inf)
    return score(scored, make_config(preset, **{**of_set, **changes}))


if __name__ == "__main__":
    sys.exit(main())
