#!/usr/bin/env python3
"""Measure the contribution of each step of the verified method: run `default` without one step at a time.

  python scripts/ablation/steps.py                     simulated seeds 700-703 of two sensors, odd windows of KITTI
  python scripts/ablation/steps.py --sets bridge tram   other sets of sets.py; --seeds selects others
  python scripts/ablation/steps.py --without coverage   only all steps, and all but this one

The columns are those of run.py.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from run import Figures, make_parser, print_table, score_preset
from sets import ScoredSet, make_sets
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.verified import changed_pixels, component_tree, motion_margin, paired_test, refinement, selection
from cflow_torch.verified.dissent import Dissent
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.spacing import Spacing


def _without_changed(sweeps: Any) -> changed_pixels.ChangedPixels:
    change = changed_pixels.find_changed(sweeps)
    return change._replace(has_changed=torch.zeros_like(change.has_changed))


def _linked_may_move(*given: Any) -> component_tree.Components:
    components = component_tree.find_components(*given)
    return replace(components, may_move=components.is_linked)


def _without_margin(*given: Any) -> motion_margin.MotionMargin:
    margin = motion_margin.motion_margin(*given)
    return margin._replace(is_dynamic=torch.ones_like(margin.is_dynamic))


def _nothing_slides(sweeps: Any, pixels: Any, groups: Any, motions: Tensor) -> Tensor:
    return torch.zeros(motions.shape[:2], dtype=torch.bool, device=motions.device)


def _nothing_is_slow(sweeps: Any, objects: Any, flow: Tensor, longest: float | None) -> Tensor:
    return torch.zeros_like(flow)


def _no_ends_move(sweeps: Any, pixels: Any, groups: Groups) -> Tensor:
    return torch.zeros(groups.count, dtype=torch.bool, device=groups.of_item.device)


def _points_are_dense(*given: Any) -> Spacing:
    return Spacing.of(*given)._replace(most=1, has_tall=False)


def _rings_are_dense(*given: Any) -> Spacing:
    spacing = Spacing.of(*given)
    return spacing._replace(rise=torch.zeros_like(spacing.rise), has_tall=False)


def _without_coverage(batch: Any, *given: Any) -> HeightSlicedSweeps:
    return HeightSlicedSweeps.of(replace(batch, coverage=None), *given)


def _no_low_points(sweeps: HeightSlicedSweeps, is_moving: Tensor) -> tuple[Tensor, Tensor]:
    none = torch.zeros(0, dtype=torch.int64, device=is_moving.device)
    return none, none


def _no_dissent(sweeps: Any, tree: Any, verdict: Any, winner: Tensor, significance: float, price: int) -> Dissent:
    return Dissent(winner, torch.full_like(winner, -1))


# For each row of the table, the steps of `VerifiedFlow` that it replaces.
STEPS: dict[str, dict[str, Any]] = {
    "all steps": {},
    "no spacing": {"draw": partial(HeightSlicedSweeps.of, measure_spacing=_points_are_dense)},
    "no spacing of rings": {"draw": partial(HeightSlicedSweeps.of, measure_spacing=_rings_are_dense)},
    "no coverage": {"draw": _without_coverage},
    "no alignment": {"align": lambda sweeps, draw: sweeps},
    "no changed pixels": {"find_changed": _without_changed},
    "no unchanged pixels": {"add_unchanged": lambda sweeps, tree, motion: tree},
    "no static test": {"find_components": _linked_may_move},
    "no links of fast objects": {"link_unlinked": lambda sweeps, components, tree, max_speed: tree},
    "no objects under overhangs": {"add_overhung": lambda sweeps, components, tree: (sweeps, tree)},
    "no aperture test": {"verify": partial(paired_test.verify, slides=_nothing_slides)},
    "no least gain": {"verify": partial(paired_test.verify, pixels_per_slice=math.inf)},
    "no price of an object": {"select_objects": partial(selection.select_objects, price=0)},
    "no dissent": {"select_objects": partial(selection.select_objects, dissent=_no_dissent)},
    "no margin": {"motion_margin": _without_margin},
    "no low points": {"find_low_points": _no_low_points},
    "no registration": {"refine": partial(refinement.refine, num_iterations=0)},
    "no slow objects of pairs": {"refine": partial(refinement.refine, slow=_nothing_is_slow)},
    "long vehicles are static": {"movable_nodes": partial(component_tree.movable_nodes, ends_move=_no_ends_move)},
}
SETTINGS: dict[str, dict[str, Any]] = {
    "no scale of 0.4 m": {"pixel_sizes": (0.2, 0.1)},
    "no scale of 0.2 m": {"pixel_sizes": (0.4, 0.1)},
}


def score_without(scored: ScoredSet, name: str) -> Figures:
    return score_preset(scored, "default", SETTINGS.get(name, {}), STEPS.get(name, {}))


def main() -> None:
    sets = ["sim av2 700-703 h=4", "sim waymo 700-703 h=4", "kitti odd h=4"]
    parser = make_parser(__doc__, sets, range(700, 704))
    names = [*STEPS, *SETTINGS]
    parser.add_argument("--without", choices=[name[3:] for name in names if name[:3] == "no "], help="one of the steps")
    given = parser.parse_args()
    if given.without is not None:
        names = ["all steps", f"no {given.without}"]
    settings = {name: partial(score_without, name=name) for name in names}
    print_table(make_sets(given.sets, given.seeds), settings)


if __name__ == "__main__":
    main()
