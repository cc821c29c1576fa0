#!/usr/bin/env python3
"""Compare presets and settings on real and simulated sets (sets.py), in one Markdown table.

  python scripts/ablation/run.py --presets paper default --sets real merged
  python scripts/ablation/run.py --set --set significance=3 --set num_history=0    `default`, and two changes of it
  python scripts/ablation/run.py --sets scenes "kitti h=4"                         single sets by their names
  python scripts/ablation/run.py --far --sets real                                 points 35 to 70 m away

Sets: real (CFLOW_DATA, else ../shared/data), odd (the other windows of the same KITTI drive), merged (a car under a
tree crown, a later part of KITTI), pandaset, scenes (small simulated drives, a window for each of five seeds), sim
(simulated drives of five sensors, h = 4, and their mean), motorway (the same on simulated motorways), cut (simulated
streets whose sweeps measure a part of the circle). We chose settings on seeds 100-103, those of fast objects on
motorways 820-821, and checked the choice on 400-403; use 300 and above for final scores only. Every setting has the
history and the region of the set unless --set changes them; scenes have the region of the preset.

Columns: end-point errors in metres over all points within 35 m ("border": 76.8 m) without ground; for scenes, means
over the drives. dynamic: objects that move by at least 0.05 m per sweep; in a scene, its scored objects. pedestrian:
error divided by speed. static: background. near, far: dynamic bucket-normalised error, mean over the classes, 0-35 m
and 35-70 m. missed: share of moving points whose flow is less than half of the true one. false: share of static points
that move. moving: number of moving points.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from functools import partial
from typing import Any, Callable, Dict, Mapping, Sequence

import numpy as np
import torch
from omegaconf import OmegaConf
from sets import NEAR, REGION, ScoredSet, make_sets

from cflow_torch import make_config, make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.evaluation.bucketed import mean_of_present
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.scored_points import score_points
from cflow_torch.types import CFlowError

COLUMNS = ("dynamic", "pedestrian", "static", "near", "far", "missed", "false", "moving")
RANGES = {"near": "0-35", "far": "35-70"}
Figures = Dict[str, float]


def main() -> None:
    parser = make_parser(__doc__, ["real", "odd", "merged"], range(100, 104))
    parser.add_argument("--presets", nargs="+", default=["default"])
    parser.add_argument("--set", nargs="*", action="append", metavar="NAME=VALUE", help="once a setting")
    parser.add_argument("--far", action="store_true", help="score points 35 to 70 m away")
    given = parser.parse_args()
    settings = {}
    for preset in given.presets:
        for changes in [OmegaConf.to_container(OmegaConf.from_dotlist(each)) for each in given.set or [[]]]:
            name = " ".join([preset, *(f"{key}={value}" for key, value in changes.items())])
            settings[name] = partial(score_preset, preset=preset, changes=changes)
    try:
        sets = make_sets(given.sets, given.seeds)
        if given.far:
            sets = [replace(scored, half_side=REGION, reach=REGION, nearest=NEAR) for scored in sets]
        print_table(sets, settings)
    except CFlowError as error:
        sys.exit(f"error: {error}")


def make_parser(description: str | None, sets: list[str], seeds: range) -> argparse.ArgumentParser:
    """Return a parser that knows the choice of sets, with its defaults."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=sets, help="groups, or sets by their names")
    parser.add_argument("--seeds", nargs="+", type=seed_range, default=[seeds], metavar="FIRST-LAST")
    return parser


def seed_range(text: str) -> range:
    """The seeds of "100-103"."""
    first, last = map(int, text.split("-"))
    return range(first, last + 1)


def print_table(sets: Sequence[ScoredSet], settings: Mapping[str, Callable[[ScoredSet], Figures]]) -> None:
    """Print a row for every setting on every set, then means over sensors."""
    torch.set_num_threads(1)
    of_sensors: dict[tuple[str, str], list[Figures]] = {}
    print(f"| set | setting | {' | '.join(COLUMNS)} |\n|{'---|' * (2 + len(COLUMNS))}", flush=True)
    for scored in sets:
        for name, score_on in settings.items():
            figures = score_on(scored)
            print_row(scored.name, name, figures)
            if scored.mean:
                of_sensors.setdefault((scored.mean, name), []).append(figures)
    for (mean, name), parts in of_sensors.items():
        print_row(mean, name, mean_figures(parts))


def print_row(of_set: str, setting: str, figures: Figures) -> None:
    """Print a row of the table; "-" for missing figures."""
    *values, moving = (figures.get(column, math.nan) for column in COLUMNS)
    shown = " | ".join("-" if math.isnan(value) else f"{value:.4f}" for value in values)
    print(f"| {of_set} | {setting} | {shown} | {moving:.0f} |", flush=True)


def settings_of_set(preset: str, history: int, half_side: float | None) -> dict[str, Any]:
    """Return the settings that all presets have on a set: its history, if the preset takes one, and its region."""
    settings: dict[str, Any] = {}
    if "num_history" in make_config(preset).as_dict():
        settings["num_history"] = history
    if half_side is not None:
        settings["point_cloud_range"] = (-half_side, -half_side, -math.inf, half_side, half_side, math.inf)
    return settings


def score_preset(scored: ScoredSet, preset: str, changes: dict[str, Any], steps: Mapping[str, Any] = {}) -> Figures:
    """Score a preset with the history and the region of a set, for a fair comparison, and with the given changes.

    `steps` are steps of `VerifiedFlow` that replace those of the model.

    Small drives are scored one by one and averaged, as in docs/limits.md.
    """
    config = make_config(preset, **{**settings_of_set(preset, scored.history, scored.half_side), **changes})
    model, frames = make_model(config), []
    for step, replacement in steps.items():
        setattr(model, step, replacement)
    for window, frame in scored.items:
        (result,) = model([replace(window, pcf=window.pcf[: config.num_future])])
        frames.append(replace(frame, residual_flow=result.residual_flow))
    if scored.group == "scenes":
        return mean_figures([pooled_figures([frame], 1, scored.reach, scored.nearest) for frame in frames])
    figures = pooled_figures(frames, scored.step, scored.reach, scored.nearest)
    return {**figures, **range_figures(frames)} if scored.mean else figures


def pooled_figures(frames: Sequence[EvalFrame], step: int = 1, reach: float = NEAR, nearest: float = 0.0) -> Figures:
    """Errors over all points of a set in a square box around the sensor, without a smaller box; NaN without points.

    "dynamic", "static": end-point error in metres of dynamic objects and of the static background; "ratio",
    "pedestrian": mean of error divided by speed of dynamic objects and of those that are pedestrians; "missed": share
    of the points of dynamic objects whose flow is less than half of the true one; "moving": their number; "false":
    share of the points of the static background that move. With `step` sweeps from t to t+1, a point is dynamic from
    0.05 m per sweep on.
    """
    scored = {"region": "box", "max_range": reach, "dynamic_threshold": MOVING * step, "three_way_flow": "residual"}
    definition = Definition("pooled", ("three_way",), **scored)
    of_frames: list[tuple[np.ndarray, ...]] = []
    for frame in frames:
        points = score_points(frame, definition)
        is_inside = points.in_region & (points.reach >= nearest)
        moves = is_inside & points.is_dynamic & (points.category > 0)
        walks = moves & (points.category == CATEGORY_INDEX["PEDESTRIAN"])
        static = is_inside & ~points.is_dynamic & (points.category == 0)
        is_missed = np.linalg.norm(points.predicted_flow, axis=1) < 0.5 * points.speed
        ratios = (points.error[chosen] / points.speed[chosen] for chosen in (moves, walks))
        is_false = points.predicted_dynamic[static]
        of_frames.append((points.error[moves], *ratios, points.error[static], is_missed[moves], is_false))
    pooled = [np.concatenate(values) for values in zip(*of_frames)]
    names = ("dynamic", "ratio", "pedestrian", "static", "missed", "false")
    return {**dict(zip(names, map(mean_of_present, pooled))), "moving": float(len(pooled[0]))}


def range_figures(frames: Sequence[EvalFrame]) -> Figures:
    """Dynamic bucket-normalised errors within 35 m, "near", and at 35-70 m, "far"."""
    metrics = SceneFlowMetrics("challenge_2026_box")
    for frame in frames:
        metrics.update(frame)
    ranges = metrics.parts["bucketed_by_range"].compute()["ranges"]
    return {name: ranges[key]["mean"]["dynamic_error"] for name, key in RANGES.items()}


def mean_figures(parts: Sequence[Figures]) -> Figures:
    """Mean of each figure over several drives or sensors, without those that do not have it."""
    return {key: mean_of_present(np.array([part[key] for part in parts])) for key in parts[0]}


if __name__ == "__main__":
    main()
