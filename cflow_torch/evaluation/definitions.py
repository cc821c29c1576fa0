"""Definitions of evaluations: the choices in which the public evaluators differ, as one frozen dataclass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Dict, List, Literal, Optional, Sequence, Tuple, get_args, get_origin, get_type_hints

import numpy as np

from cflow_torch.types import CFlowError

METRICS = ("bucketed", "bucketed_by_range", "three_way", "range_wise", "moving")
_CHALLENGE = ("bucketed", "bucketed_by_range", "three_way", "range_wise")


@dataclass(frozen=True)
class Definition:
    """Choices of an evaluation. `dataclasses.replace(definition, ...)` changes single choices.

    Args:
        name: label of the results.
        metrics: which of `METRICS` are computed.
        ego_motion: ego motion that is removed from the flow. "points": motion of the frame of the points. "stored":
            motion of the stored poses, even where they belong to another frame (OpenSceneFlow's Argoverse 2 scenes).
        region: how ranges are measured, "box" by max(|x|, |y|), "disc" by sqrt(x^2 + y^2).
        max_range: metres, outer bound of the region whose points "bucketed" and "three_way" score; inf = all points.
        closed: whether a point at exactly `max_range` is scored (<= or <). The same holds for the upper edge of each
            range of "bucketed_by_range"; a point that one range leaves out belongs to the next one.
        region_edges: metres, ascending edges of the ranges that "bucketed_by_range" scores one by one.
        region_axes: ego frame in which the region is measured.
        point_cloud_range: (x0, y0, z0, x1, y1, z1) metres, open interval, in `region_axes`; None = no crop.
        mask_box: metres; in a frame without an evaluation mask, only points with |x|, |y| <= `mask_box` at t are
            scored; None = all.
        residual_axes: axes in which residuals are compared.
        three_way_flow: flow that the three-way scores compare. It affects accuracy and angle, not the end-point error.
        ground: "ignored": ground is not scored; "scored": it is.
        truth: "flow": points of unknown flow are not scored; "motion": they are, if the labels say that they move.
        half_precision: round truth and prediction of the three-way scores to float16, as the 2023 challenge does.
        foreground: "all": every category but background; "meta": only the four meta classes, others are ignored.
        background: "static": all background points are in bucket 0; "bucketed": each is in the bucket of its speed.
        average: average of the three-way end-point errors and IoU. "points": over all points of all frames, NaN where
            there are none. "frames": over frames, where a frame without points of a set counts as 0.
        nan_rows: "drop": a point with NaN in position, truth or prediction is not scored, which flatters a method that
            returns NaN (`num_nan` counts them). "error": NaN raises a `CFlowError`.
        norm_dtype: precision in which lengths of residuals are computed.
        dynamic_threshold: metres per frame; true or predicted residual from which a point is dynamic (three-way).
        speed_edges: metres per frame, ascending edges of the buckets; the first is "static". Lower edges are included.
        sweep_interval: seconds between the sweeps of a pair (angle error, range-wise speed).

    Raises:
        CFlowError: an unknown choice or edges that do not ascend.
    """

    name: str
    metrics: Tuple[str, ...] = ("bucketed", "three_way", "range_wise")
    ego_motion: Literal["points", "stored"] = "points"
    region: Literal["box", "disc"] = "disc"
    max_range: float = 35.0
    closed: bool = True
    region_edges: Tuple[float, ...] = (0.0, 35.0, 70.0)
    region_axes: Literal["t", "t+1"] = "t"
    point_cloud_range: Optional[Tuple[float, ...]] = None
    mask_box: Optional[float] = None
    residual_axes: Literal["t", "t+1"] = "t+1"
    three_way_flow: Literal["total", "residual"] = "total"
    ground: Literal["ignored", "scored"] = "ignored"
    truth: Literal["flow", "motion"] = "flow"
    half_precision: bool = False
    foreground: Literal["all", "meta"] = "all"
    background: Literal["static", "bucketed"] = "static"
    average: Literal["points", "frames"] = "points"
    nan_rows: Literal["drop", "error"] = "drop"
    norm_dtype: Literal["float32", "float64"] = "float64"
    dynamic_threshold: float = 0.05
    speed_edges: Tuple[float, ...] = (*np.linspace(0.0, 2.0, 51).tolist(), math.inf)
    sweep_interval: float = 0.1

    def __post_init__(self) -> None:
        for field, kind in get_type_hints(Definition).items():
            value = getattr(self, field)
            choices = get_args(kind)
            if get_origin(kind) is Literal and value not in choices:
                raise CFlowError(f"definition {self.name}: {field}={value!r}, give one of {choices}")
        if not set(self.metrics) <= set(METRICS):
            raise CFlowError(f"definition {self.name}: metrics={self.metrics}, give some of {METRICS}")
        for field in ("speed_edges", "region_edges"):
            edges = getattr(self, field)
            if len(edges) < 2 or not all(a < b for a, b in zip(edges, edges[1:])):
                raise CFlowError(f"definition {self.name}: {field}={edges}, give at least two ascending values")


DEFINITIONS: Dict[str, Definition] = {
    # KTH-RPL/OpenSceneFlow: eval.py and its functions evaluate_leaderboard, _v2, evaluate_ssf.
    "opensceneflow": Definition(name="opensceneflow", average="frames", ego_motion="stored"),
    # kylevedder/BucketedSceneFlowEval with_ground=False, evaluators bucketed_epe and threeway_epe. Its ground is the
    # map raster rule "bsfe" (0.4 m), which the reader applies (cflow_torch.data.av2).
    "bucketed_scene_flow_eval": Definition(
        name="bucketed_scene_flow_eval",
        metrics=("bucketed", "three_way"),
        region="box",
        closed=False,
        region_axes="t+1",
        point_cloud_range=(-48.0, -48.0, -2.5, 48.0, 48.0, 2.5),
        residual_axes="t",
        three_way_flow="residual",
        foreground="meta",
        background="bucketed",
        nan_rows="error",
        norm_dtype="float32",
    ),
    # argoverse/av2-api: av2.evaluation.scene_flow.eval. It has no limit of 35 m except in the close / far breakdown.
    "av2": Definition(
        name="av2",
        metrics=("three_way",),
        max_range=math.inf,
        mask_box=50.0,
        half_precision=True,
        nan_rows="error",
    ),
    # The two ranges of the 2026 multi-data-set challenge, scored in one pass with the rules of opensceneflow. The
    # challenge's own code is not public. We do not know whether it measures a disc or a box, so there is one of each.
    "challenge_2026": Definition(name="challenge_2026", metrics=_CHALLENGE, average="frames", ego_motion="stored"),
    "challenge_2026_box": Definition(
        name="challenge_2026_box", metrics=_CHALLENGE, average="frames", ego_motion="stored", region="box"
    ),
    # Moving object segmentation of SemanticKITTI: evaluate_mos.py of PRBonn/semantic-kitti-api.
    "mos": Definition(name="mos", metrics=("moving",), max_range=math.inf, ground="scored", truth="motion"),
}


def interval_of(values: np.ndarray, edges: Sequence[float], closed: bool = False) -> np.ndarray:
    """Return (M,) int64, the interval between ascending edges that each of (M,) values lies in; -1 = outside all.

    An interval contains its lower edge. If `closed`, it contains its upper edge instead; the first one also contains 0.
    """
    index = np.searchsorted(np.asarray(edges), values, side="left" if closed else "right") - 1
    if closed and edges[0] == 0:
        index = np.maximum(index, 0)
    return np.where(index < len(edges) - 1, index, -1)


def range_names(edges: Sequence[float]) -> List[str]:
    """Return the names of the ranges between ascending edges: "0-35", "35-70"."""
    return [f"{low:g}-{high:g}" for low, high in zip(edges, edges[1:])]
