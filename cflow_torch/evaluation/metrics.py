"""All metrics of one definition, frame by frame, and the combined score of several data sets."""

from __future__ import annotations

import math
from collections import Counter
from statistics import fmean
from typing import Any, Callable, Mapping, NamedTuple, Sequence

from cflow_torch.evaluation.bucketed import BucketedByRange, BucketedEPE, RangeWiseEPE
from cflow_torch.evaluation.definitions import DEFINITIONS, Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.moving import MovingIoU
from cflow_torch.evaluation.scored_points import Accumulator, score_points
from cflow_torch.evaluation.three_way import ThreeWayEPE
from cflow_torch.types import CFlowError

_ACCUMULATORS: dict[str, Callable[..., Accumulator]] = {
    "bucketed": BucketedEPE,
    "bucketed_by_range": BucketedByRange,
    "three_way": ThreeWayEPE,
    "range_wise": RangeWiseEPE,
    "moving": MovingIoU,
}


class SceneFlowMetrics:
    """Accumulate all metrics of a definition over frames, in any order.

    Args:
        definition: a name in `DEFINITIONS` ("opensceneflow", "bucketed_scene_flow_eval", "av2", ...) or a
            `Definition`.
    """

    def __init__(self, definition: str | Definition = "opensceneflow") -> None:
        if not isinstance(definition, Definition):
            if definition not in DEFINITIONS:
                raise CFlowError(f"definition={definition!r}: give one of {', '.join(sorted(DEFINITIONS))}")
            definition = DEFINITIONS[definition]
        self.definition = definition
        self.parts: dict[str, Accumulator] = {
            name: _ACCUMULATORS[name](self.definition) for name in self.definition.metrics
        }
        self.counts = Counter(num_frames=0, num_points=0, num_nan=0)

    def update(self, frame: EvalFrame) -> None:
        """Add one frame; NaN that the definition forbids, or a missing T_ego1_ego0, is a `CFlowError`."""
        scored = score_points(frame, self.definition)
        for metric in self.parts.values():
            metric.update_points(scored)
        self.counts.update(num_frames=1, num_points=len(scored.error), num_nan=scored.num_nan)

    def merge(self, other: SceneFlowMetrics) -> None:
        """Add the frames of another accumulator. If its definition differs, that is a `CFlowError`."""
        if other.definition != self.definition:
            raise CFlowError(f"cannot merge scores of {other.definition.name} into {self.definition.name}")
        for metric, another in zip(self.parts.values(), other.parts.values()):
            metric.merge(another)
        self.counts.update(other.counts)

    def compute(self) -> dict[str, Any]:
        """Return a dictionary: "definition", "num_frames", "num_points", "num_nan", and a dictionary per metric."""
        return {
            "definition": self.definition.name,
            **self.counts,
            **{name: metric.compute() for name, metric in self.parts.items()},
        }


class ProtocolScores(NamedTuple):
    """Combined scores of several data sets.

    Args:
        overall: unweighted mean over data sets; NaN if anything is missing.
        data_sets: data set -> mean of its ranges; NaN if one of them is missing.
        ranges: range -> unweighted mean over data sets; NaN if one of them is missing.
        missing: a message for each missing value, with its data set and range; empty if nothing is missing.
    """

    overall: float
    data_sets: dict[str, float]
    ranges: dict[str, float]
    missing: tuple[str, ...]


def errors_by_range(results: Mapping[str, Any]) -> dict[str, float]:
    """Return the dynamic bucket-normalised error of each range ("0-35", ...), a mean over classes.

    It is NaN if the range has no dynamic points. `results` are those of `SceneFlowMetrics.compute` or of results.json.
    Results without the metric "bucketed_by_range" are a `CFlowError`.
    """
    if "bucketed_by_range" not in results:
        raise CFlowError("the results have no 'bucketed_by_range': use definition='challenge_2026'")
    ranges = results["bucketed_by_range"]["ranges"]
    return {name: _number(scores["mean"]["dynamic_error"]) for name, scores in ranges.items()}


def score_data_sets(
    results: Mapping[str, Mapping[str, float | None]],
    data_sets: Sequence[str] | None = None,
    ranges: Sequence[str] | None = None,
) -> ProtocolScores:
    """Combine the errors of several data sets: the mean over ranges, then the unweighted mean over data sets.

    Args:
        results: data set -> range -> error, for example `{"AV2": errors_by_range(scores)}`; NaN or None = no value.
        data_sets: required data sets, for example ("AEVA", "AV2", "nuScenes", "TruckScenes", "Waymo"); None = those of
            `results`.
        ranges: ranges that every data set must have; None = every range of any data set.

    Returns:
        Scores overall, per data set and per range. A mean over fewer data sets or ranges than required is NaN; the
        reasons are in `missing`.

    Raises:
        CFlowError: data sets or ranges that are not among the required ones; there is nothing to combine.
    """
    given = list(dict.fromkeys(name for row in results.values() for name in row))
    set_names = list(results if data_sets is None else data_sets)
    range_names = list(given if ranges is None else ranges)
    if not set_names or not range_names:
        raise CFlowError(f"there is nothing to combine: data sets {set_names}, ranges {range_names}")
    unknown = [name for name in (*results, *given) if name not in (*set_names, *range_names)]
    if unknown:
        raise CFlowError(f"{unknown} given, but only {set_names}, {range_names} required: leave out, or require all")
    reasons: list[str] = []
    table: dict[str, list[float]] = {}
    for set_name in set_names:
        row = results.get(set_name, {})
        table[set_name] = [_number(row.get(name)) for name in range_names]
        for name, value in zip(range_names, table[set_name]):
            if math.isnan(value):
                why = "no dynamic points (NaN)" if name in row else "no result"
                reasons.append(f"data set {set_name}, range {name}: {why}")
    per_set = {name: fmean(row) for name, row in table.items()}  # NaN if any is NaN
    per_range = {name: fmean([row[i] for row in table.values()]) for i, name in enumerate(range_names)}
    return ProtocolScores(fmean(per_set.values()), per_set, per_range, tuple(reasons))


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
