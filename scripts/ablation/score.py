"""Score a setting on a set of windows."""

from __future__ import annotations

import math
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
from cflow_torch.evaluation.three_way import ThreeWayEPE
from cflow_torch.types import as_numpy

Figures = Dict[str, float]
CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
RANGES = {"near": "0-35", "far": "35-70"}
LOW = 0.5  # confidences below are a warning


def score(scored: ScoredSet, config: Config) -> Figures:
    """Score a setting on a set: `pooled_figures`, and for simulated sensors also `range_figures`.

    Convention: small drives are scored one by one and averaged, as in docs/limits.md.
    """
    model, frames, confidences = make_model(config), [], []
    for item in scored.items():
        past, future = item.window.pch[: config.num_history], item.window.pcf[: config.num_future]
        (result,) = model([replace(item.window, pch=past, pcf=future)])
        frames.append(item.frame(result.residual_flow))
        has_confidence = result.confidence is not None
        confidences.append(as_numpy(result.confidence) if has_confidence else np.full(len(result.flow), np.nan))
    if scored.group == "scenes":
        return mean_figures([pooled_figures(*one, reach=scored.reach) for one in zip(zip(frames), zip(confidences))])
    figures = pooled_figures(frames, confidences, scored.step, scored.reach)
    return {**figures, **range_figures(frames)} if scored.group == "sim" else figures


def pooled_figures(
    frames: Sequence[EvalFrame], confidences: Sequence[np.ndarray], step: int = 1, reach: float = NEAR
) -> Figures:
    """Errors over all points of a set in a square box around the sensor.

    Args:
        frames: windows with estimates.
        confidences: (N,) each, NaN where the method has none.
        step: sweeps from t to t+1; a point is dynamic from 0.05 m per sweep on.
        reach: metres, half side of the box.

    Returns:
        "dynamic", "static": EPE in metres of dynamic objects and of the static background; "all static": that of all
        static points, including parked cars; "pedestrian": mean of error divided by speed of dynamic pedestrians;
        "missed": share of points of dynamic objects whose flow is less than half of the true one; "flagged": share of
        these with a confidence below 0.5; "at 1 %": share of these with a confidence below that of 99 % of the static
        points; "moving": number of points of dynamic objects. NaN without such points.
    """
    definition = Definition(
        name="pooled",
        metrics=("three_way",),
        region="box",
        max_range=reach,
        dynamic_threshold=MOVES * step,
    )
    three_way = ThreeWayEPE(definition)
    of_pedestrians: list[np.ndarray] = []
    of_static: list[np.ndarray] = []
    is_missed: list[np.ndarray] = []
    confidence_of_missed: list[np.ndarray] = []
    confidence_of_static: list[np.ndarray] = []
    for frame, confidence in zip(frames, confidences):
        points = score_points(frame, definition)
        three_way.update_points(points)
        walks = points.in_region & points.is_dynamic & (points.category == CATEGORY_INDEX["PEDESTRIAN"])
        of_pedestrians.append(points.error[walks] / points.speed[walks])
        of_static.append(points.error[points.in_region & ~points.is_dynamic])
        truth, estimate = frame.labels.flow - frame.pose_flow, as_numpy(frame.residual_flow)
        speed = np.linalg.norm(truth, axis=1)
        counts = is_scored(frame, reach)
        moves = counts & (speed >= MOVES * step) & (frame.labels.category > 0)
        missed = np.linalg.norm(estimate, axis=1) < 0.5 * speed
        is_missed.append(missed[moves])
        confidence_of_missed.append(confidence[moves & missed])
        confidence_of_static.append(confidence[counts & (speed < MOVES * step)])
    means = three_way.compute()
    flagged, static = np.concatenate(confidence_of_missed), np.sort(np.concatenate(confidence_of_static))
    percentile = static[len(static) // 100] if len(static) else math.nan
    return {
        "dynamic": means["epe_fd"],
        "static": means["epe_bs"],
        "all static": mean_of_present(np.concatenate(of_static)),
        "pedestrian": mean_of_present(np.concatenate(of_pedestrians)),
        "missed": mean_of_present(np.concatenate(is_missed)),
        "flagged": _share_below(flagged, LOW),
        "at 1 %": _share_below(flagged, percentile),
        "moving": float(sum(map(len, is_missed))),
    }


def _share_below(confidence: np.ndarray, bound: float) -> float:
    return mean_of_present(np.where(np.isnan(confidence) | math.isnan(bound), np.nan, confidence < bound))


def is_scored(frame: EvalFrame, reach: float) -> np.ndarray:
    """(N,) bool: labelled points in the box that are not ground."""
    counts = frame.labels.is_valid & (np.abs(as_numpy(frame.points)[:, :2]) <= reach).all(1)
    for mask, wanted in ((frame.is_ground, False), (frame.eval_mask, True)):
        if mask is not None:
            counts &= as_numpy(mask) == wanted
    return counts


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
