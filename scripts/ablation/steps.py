#!/usr/bin/env python3
"""Measure the contribution of each step of the verified method: run `default` without one step at a time.

  python scripts/ablation/steps.py                     simulated seeds 700-703 of two sensors, odd windows of KITTI
  python scripts/ablation/steps.py --sets bridge tram   other sets of sets.py; --seeds selects others

The columns are those of run.py.
"""

from __future__ import annotations

from contextlib import nullcontext
from functools import partial
from typing import Any, ContextManager
from unittest.mock import patch

import torch
from run import Figures, make_parser, print_table, score_preset
from sets import ScoredSet, make_sets

from cflow_torch.verified import changed_pixels, component_tree, confidence, method, paired_test, refinement


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


def _no_ends_move(sweeps: Any, roots: Any, is_long: Any) -> Any:
    return torch.zeros_like(is_long)


# For each step, what replaces it.
STEPS: dict[str, ContextManager[Any]] = {
    "all steps": nullcontext(),
    "no changed pixels": patch.object(method, "find_changed", _without_changed),
    "no unchanged pixels": patch.object(method, "add_unchanged", lambda sweeps, nodes, *_: nodes),
    "no static test": patch.object(component_tree, "_MISSING", 1 << 40),
    "no objects under overhangs": patch.object(method, "add_overhung", lambda sweeps, _, nodes: (sweeps, nodes)),
    "no aperture test": patch.object(paired_test, "slides_along_itself", _nothing_slides),
    "no least gain": patch.object(paired_test, "_LEAST_GAIN", 0),
    "no price of an object": patch.object(component_tree, "_PRICE", 0),
    "no margin": patch.object(method, "motion_margin", _without_margin),
    "no registration": patch.object(refinement, "NUM_STEPS", 0),
    "no slow objects of pairs": patch.object(refinement, "subpixel_motion", _nothing_is_slow),
    "long vehicles are static": patch.object(component_tree, "both_ends_move", _no_ends_move),
}
SETTINGS: dict[str, dict[str, Any]] = {
    "no scale of 0.4 m": {"pixel_sizes": (0.2, 0.1)},
    "no scale of 0.2 m": {"pixel_sizes": (0.4, 0.1)},
}


def score_without(scored: ScoredSet, name: str) -> Figures:
    with STEPS.get(name, nullcontext()):
        return score_preset(scored, "default", SETTINGS.get(name, {}))


def main() -> None:
    sets = ["sim av2 700-703 h=4", "sim waymo 700-703 h=4", "kitti odd h=4"]
    given = make_parser(__doc__, sets, range(700, 704)).parse_args()
    settings = {name: partial(score_without, name=name) for name in (*STEPS, *SETTINGS)}
    print_table(make_sets(given.sets, given.seeds), settings)


if __name__ == "__main__":
    main()
