#!/usr/bin/env python3
"""Measure the contribution of each step of the verified method: run `default` without one step at a time.

  python scripts/ablation/steps.py                     simulated seeds 700-703 of two sensors, odd windows of KITTI
  python scripts/ablation/steps.py --sets bridge tram   other sets of sets.py; --seeds selects others

The columns are those of run.py.
"""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from typing import Any, Callable
from unittest.mock import patch

import torch
from run import CACHE, make_parser, print_table, score_preset
from score import Figures
from sets import ScoredSet, make_sets

from cflow_torch.verified import (
    changed_pixels,
    component_tree,
    confidence,
    method,
    paired_test,
    refinement,
)


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
    "no unchanged pixels": [lambda: patch.object(method, "add_unchanged", lambda sweeps, nodes, *_: nodes)],
    "no static test": [lambda: patch.object(component_tree, "_MISSING", 1 << 40)],
    "no objects under overhangs": [
        lambda: patch.object(method, "add_overhung", lambda sweeps, _, nodes: (sweeps, nodes))
    ],
    "no aperture test": [lambda: patch.object(paired_test, "slides_along_itself", _nothing_slides)],
    "no least gain": [lambda: patch.object(paired_test, "_LEAST_GAIN", 0)],
    "no price of an object": [lambda: patch.object(component_tree, "_PRICE", 0)],
    "no margin": [lambda: patch.object(method, "motion_margin", _without_margin)],
    "no registration": [lambda: patch.object(refinement, "NUM_STEPS", 0)],
    "no slow objects of pairs": [lambda: patch.object(refinement, "subpixel_motion", _nothing_is_slow)],
    "long vehicles are static": [
        lambda: patch.object(component_tree, "both_ends_move", lambda sweeps, roots, is_long: torch.zeros_like(is_long))
    ],
}
SETTINGS: dict[str, dict[str, Any]] = {
    "no scale of 0.4 m": {"pixel_sizes": (0.2, 0.1)},
    "no scale of 0.2 m": {"pixel_sizes": (0.4, 0.1)},
}


def score_without(scored: ScoredSet, name: str) -> Figures:
    """Score `default` without a step."""
    with ExitStack() as stack:
        for make_patch in STEPS.get(name, []):
            stack.enter_context(make_patch())
        return score_preset(scored, "default", SETTINGS.get(name, {}))


def main() -> None:
    """Print the table, row by row."""
    given = make_parser(
        __doc__, [*(f"sim {sensor} 700-703 h=4" for sensor in ("av2", "waymo")), "kitti odd h=4"], (700, 703)
    ).parse_args()
    settings = {name: partial(score_without, name=name) for name in (*STEPS, *SETTINGS)}
    print_table(make_sets(given.sets, given.seeds, CACHE), settings)


if __name__ == "__main__":
    main()
