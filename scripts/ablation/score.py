"""Score a setting on a set of windows."""

from __future__ import annotations

from dataclasses import replace
from typing import Dict, Sequence

import numpy as np
from derived_sets import MOVES
from sets import NEAR, ScoredSet

from cflow_torch import make_model
from cflow_torch.config import Config
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.evaluation.bucketed import mean_of_present
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.scored_points import score_points

Figures = Dict[str, float]
CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
RANGES = {"near": "0-35", "far": "35-70"}


def score(scored: ScoredSet, config: Config) -> Figures:
    """Score a setting on a set: `pooled_figures`, and for simulated sensors also `range_figures`.

    Convention: small drives are scored one by one and averaged, as in docs/limits.md.
    """
    model, frames = make_model(config), []
    for item in scored.items():
        past, future = item.window.pch[: config.num_history], item.window.pcf[: config.num_future]
        (result,) = model([replace(item.window, pch=past, pcf=future)])
        frames.append(item.frame(result.residual_flow))
    if scored.group == "scenes":
        return mean_figures([pooled_figures([frame], reach=scored.reach) for frame in frames])
    figures = pooled_figures(frames, scored.step, scored.reach)
    return {**figures, **range_figures(frames)} if scored.group == "sim" else figures


def pooled_figures(frames: Sequence[EvalFrame], step: int = 1, reach: float = NEAR) -> Figures:
    """Errors over all points of a set in a square box around the sensor; NaN without such points.

    "dynamic", "static": end-point error in metres of dynamic objects and of the static background; "ratio",
    "pedestrian": mean of error divided by speed of dynamic objects and of those that are pedestrians; "missed": share
    of the points of dynamic objects whose flow is less than half of the true one; "moving": their number. With `step`
    sweeps from t to t+1, a point is dynamic from 0.05 m per sweep on.
    """
    scored = {"region": "box", "max_range": reach, "dynamic_threshold": MOVES * step, "three_way_flow": "residual"}
    definition = Definition("pooled", ("three_way",), **scored)
    of_frames: list[tuple[np.ndarray, ...]] = []
    for frame in frames:
        points = score_points(frame, definition)
        moves = points.in_region & points.is_dynamic & (points.category > 0)
        walks = moves & (points.category == CATEGORY_INDEX["PEDESTRIAN"])
        static = points.in_region & ~points.is_dynamic & (points.category == 0)
        is_missed = np.linalg.norm(points.predicted_flow, axis=1) < 0.5 * points.speed
        ratios = (points.error[chosen] / points.speed[chosen] for chosen in (moves, walks))
        of_frames.append((points.error[moves], *ratios, points.error[static], is_missed[moves]))
    pooled = [np.concatenate(values) for values in zip(*of_frames)]
    names = ("dynamic", "ratio", "pedestrian", "static", "missed")
    return {**dict(zip(names, map(mean_of_present, pooled))), "moving": float(len(pooled[0]))}


def range_figures(frames: Sequence[EvalFrame]) -> Figures:
    """Dynamic bucket-normalised errors within 35 m, "near", and at 35-70 m, "far"; also of each class, "near CAR"."""
    metrics = SceneFlowMetrics("challenge_2026_box")
    for frame in frames:
        metrics.update(frame)
    ranges = metrics.parts["bucketed_by_range"].compute()["ranges"]
    figures = {name: ranges[key]["mean"]["dynamic_error"] for name, key in RANGES.items()}
    for name, key in RANGES.items():
        figures.update({f"{name} {c}": ranges[key]["classes"][c]["dynamic_error"] for c in CLASSES})
    return figures


def mean_figures(parts: Sequence[Figures]) -> Figures:
    """Mean of each figure over several drives or sensors, without those that do not have it."""
    return {key: mean_of_present(np.array([part[key] for part in parts])) for key in parts[0]}
