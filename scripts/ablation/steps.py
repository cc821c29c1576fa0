#!/usr/bin/env python3
"""Measure the contribution of each step of the verified method: run `default` without one step at a time.

  python scripts/ablation/steps.py                     simulated seeds 700-703 of two sensors, odd windows of KITTI
  python scripts/ablation/steps.py --sets bridge tram   other sets of sets.py; --seeds selects others

Columns: end-point error of dynamic objects, of dynamic pedestrians (divided by speed) and of the static background, in
metres; near, far: dynamic bucket-normalised error within 35 m and at 35-70 m.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Callable
from unittest.mock import patch

import torch
from run import config_for, seed_range
from score import score
from sets import make_sets

from cflow_torch.verified import (
    changed_pixels,
    component_tree,
    confidence,
    method,
    paired_test,
    refinement,
    rigid_registration,
)

COLUMNS = ("dynamic", "pedestrian", "static", "near", "far")


def _without_changed(sweeps: Any) -> Any:
    change = changed_pixels.find_changed(sweeps)
    return changed_pixels.ChangedPixels(change.is_missing, torch.zeros_like(change.has_changed))


def _without_margin(*given: Any) -> Any:
    margin = confidence.motion_margin(*given)
    return confidence.MotionMargin(margin.z, torch.ones_like(margin.is_dynamic))


def _nothing_slides(sweeps: Any, members: Any, component: Any, candidates: Any, is_covered: Any) -> Any:
    return torch.zeros(candidates.shape[:2], dtype=torch.bool, device=candidates.device)


def _nothing_is_slow(sweeps: Any, objects: Any, motion: Any, may_be_slow: Any) -> Any:
    return motion.flip(1) * sweeps.grid.pixel_size


# For each step, the function that replaces it.
STEPS: dict[str, list[Callable[[], Any]]] = {
    "all steps": [],
    "no changed pixels": [lambda: patch.object(method, "find_changed", _without_changed)],
    "no static test": [lambda: patch.object(component_tree, "_MISSING", 1 << 40)],
    "no objects under overhangs": [
        lambda: patch.object(method, "add_overhung", lambda sweeps, _, nodes: (sweeps, nodes))
    ],
    "no aperture test": [lambda: patch.object(paired_test, "slides_along_itself", _nothing_slides)],
    "no price of an object": [lambda: patch.object(component_tree, "_PRICE", 0)],
    "no margin": [lambda: patch.object(method, "motion_margin", _without_margin)],
    "no registration": [lambda: patch.object(rigid_registration, "_NUM_STEPS", 0)],
    "no slow objects of pairs": [lambda: patch.object(refinement, "subpixel_motion", _nothing_is_slow)],
    "long vehicles are static": [
        lambda: patch.object(component_tree, "both_ends_move", lambda sweeps, roots, is_long: torch.zeros_like(is_long))
    ],
}
SETTINGS: dict[str, dict[str, Any]] = {
    "no scale of 0.4 m": {"pixel_sizes": (0.2, 0.1)},
    "no scale of 0.2 m": {"pixel_sizes": (0.4, 0.1)},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = [f"sim {sensor} 700-703 h=4" for sensor in ("av2", "waymo")]
    parser.add_argument("--sets", nargs="+", default=[*default, "kitti odd h=4"])
    parser.add_argument("--seeds", nargs="+", type=seed_range, default=[(700, 703)], metavar="FIRST-LAST")
    parser.add_argument("--cache", type=Path, default=Path(os.environ.get("CFLOW_CACHE") or "outputs/cache"))
    given = parser.parse_args()
    torch.set_num_threads(1)
    print(f"| set | left out | {' | '.join(COLUMNS)} |\n|{'---|' * (2 + len(COLUMNS))}")
    for scored in make_sets(given.sets, given.seeds, given.cache):
        for name in (*STEPS, *SETTINGS):
            with ExitStack() as stack:
                for make_patch in STEPS.get(name, []):
                    stack.enter_context(make_patch())
                figures = score(scored, config_for(scored, "default", SETTINGS.get(name, {})))
            cells = (figures.get(column, math.nan) for column in COLUMNS)
            row = " | ".join("-" if math.isnan(value) else f"{value:.4f}" for value in cells)
            print(f"| {scored.name} | {name} | {row} |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
