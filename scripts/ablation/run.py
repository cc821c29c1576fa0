#!/usr/bin/env python3
"""Compare presets and settings on real and simulated sets (sets.py), in one Markdown table.

  python scripts/ablation/run.py --presets paper fast default --sets real merged
  python scripts/ablation/run.py --set --set thorough=false --set num_history=0    `default`, and two changes of it
  python scripts/ablation/run.py --sets scenes "kitti h=4"                         single sets by their names

Sets: real (CFLOW_DATA, else ../shared/data), odd (the other windows of the same KITTI drive), merged (a car under a
tree crown, a later part of KITTI), pandaset, scenes (small simulated drives, a window for each of five seeds), sim
(simulated drives of five sensors, h = 4, and their mean). We chose settings on seeds 100-103 and checked the choice on
400-403; use 300 and above for final scores only. Every setting has the history and the region of the set unless --set
changes them; scenes have the region of the preset.

Columns: end-point errors in metres over all points within 35 m ("border": 76.8 m) without ground; for scenes, means
over the drives. dynamic: objects that move by at least 0.05 m per sweep; in a scene, its scored objects. pedestrian:
error divided by speed. static: background. all static: also parked cars. near, far: dynamic bucket-normalised error,
mean over the classes, 0-35 m and 35-70 m. missed: share of moving points whose flow is less than half of the true one.
flagged: share of these with a confidence below 0.5. at 1 %: share of these with a confidence below that of 99 % of the
static points. moving: number of moving points. The JSON file also has near and far of each class.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
from pathlib import Path
from typing import Any, Sequence

import torch
from omegaconf import OmegaConf
from score import Figures, mean_figures, score
from sets import ScoredSet, make_sets

from cflow_torch.config import Config, make_config
from cflow_torch.data.json_file import write_json
from cflow_torch.types import CFlowError

COLUMNS = ("dynamic", "pedestrian", "static", "all static", "near", "far", "missed", "flagged", "at 1 %", "moving")


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table, row by row; returns the exit status."""
    given = parse(arguments)
    torch.set_num_threads(given.threads)
    changed = [OmegaConf.to_container(OmegaConf.from_dotlist(changes)) for changes in given.set or [[]]]
    settings = [(preset, changes) for preset in given.presets for changes in changed]
    scores: dict[str, dict[str, Figures]] = {}  # by set, then by setting
    sensors: dict[str, list[str]] = {}
    try:
        sets = make_sets(given.sets, given.seeds, given.cache)
        print(line(("set", "setting", *COLUMNS)) + line(["---"] * (2 + len(COLUMNS))), end="", flush=True)
        for scored in sets:
            scores[scored.name] = {}
            for preset, changes in settings:
                name = " ".join([preset, *(f"{key}={value}" for key, value in changes.items())])
                scores[scored.name][name] = score(scored, config_for(scored, preset, changes))
                print(row(scored.name, name, scores[scored.name][name]), end="", flush=True)
            if scored.mean:
                sensors.setdefault(scored.mean, []).append(scored.name)
    except CFlowError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    for mean, parts in sensors.items():
        scores[mean] = {name: mean_figures([scores[part][name] for part in parts]) for name in scores[parts[0]]}
        print("".join(row(mean, name, figures) for name, figures in scores[mean].items()), end="")
    if given.json:
        write_json(given.json, scores)
    return 0


def config_for(scored: ScoredSet, preset: str, changes: dict[str, Any]) -> Config:
    """A preset with the history and the region of a set, for a fair comparison, and with the given changes."""
    of_set: dict[str, Any] = {"num_history": scored.history}
    if scored.half_side is not None:
        half = scored.half_side
        of_set["point_cloud_range"] = (-half, -half, -math.inf, half, half, math.inf)
    return make_config(preset, **{**of_set, **changes})


def row(of_set: str, setting: str, figures: Figures) -> str:
    """A row of the table; "-" for missing figures."""
    values = [figures.get(column, math.nan) for column in COLUMNS]
    *shares, moving = ("-" if math.isnan(value) else f"{value:.4f}" for value in values)
    return line([of_set, setting, *shares, moving.partition(".")[0]])


def line(texts: Sequence[str]) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(texts)} |\n"


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the arguments of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--presets", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", action="append", metavar="NAME=VALUE", help="once a setting")
    parser.add_argument("--sets", nargs="+", default=["real", "odd", "merged"], help="groups, or sets by their names")
    parser.add_argument("--seeds", nargs="+", type=seed_range, default=[(100, 103)], metavar="FIRST-LAST")
    cache = Path(os.environ.get("CFLOW_CACHE") or "outputs/cache")
    parser.add_argument("--cache", type=Path, default=cache, help="folder for simulated drives; default $CFLOW_CACHE")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    return parser.parse_args(arguments)


def seed_range(text: str) -> tuple[int, int]:
    """First and last seed of "100-103"."""
    match = re.fullmatch(r"(\d+)-(\d+)", text)
    if match is None or int(match[1]) > int(match[2]):
        raise argparse.ArgumentTypeError(f"{text!r}: give a first and a last seed, for example 100-103")
    return int(match[1]), int(match[2])


if __name__ == "__main__":
    sys.exit(main())
