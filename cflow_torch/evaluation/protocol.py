"""One number from several data sets: mean of a data set's ranges, then the unweighted mean over data sets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import fmean
from typing import Any, Mapping, Sequence

from cflow_torch.types import CFlowError

CHALLENGE_DATA_SETS: tuple[str, ...] = ("AEVA", "AV2", "nuScenes", "TruckScenes", "Waymo")
CHALLENGE_RANGES: tuple[str, ...] = ("0-35", "35-70")


@dataclass(frozen=True)
class ProtocolScores:
    """What `score_data_sets` returns.

    Args:
        overall: unweighted mean over data sets; NaN if anything is missing.
        data_sets: data set -> mean of its ranges; NaN if one of them is missing.
        ranges: range -> unweighted mean over data sets; NaN if one of them is missing.
        missing: one sentence for each range of a data set without a value; empty if all are there.
    """

    overall: float
    data_sets: dict[str, float]
    ranges: dict[str, float]
    missing: tuple[str, ...]


def errors_by_range(results: Mapping[str, Any]) -> dict[str, float]:
    """Dynamic bucket-normalised error of each range, mean over classes, of what `SceneFlowMetrics.compute` returned.

    Args:
        results: scores of a definition with the metric "bucketed_by_range", also as read back from results.json.

    Returns:
        Range ("0-35", ...) -> error; NaN where the range has no moving points.

    Raises:
        CFlowError: the metric is not among the results.
    """
    if "bucketed_by_range" not in results:
        raise CFlowError("the results have no 'bucketed_by_range': score with definition='challenge_2026'")
    ranges = results["bucketed_by_range"]["ranges"]
    return {name: _number(scores["mean"]["dynamic_error"]) for name, scores in ranges.items()}


def score_data_sets(
    results: Mapping[str, Mapping[str, float | None]],
    data_sets: Sequence[str] | None = None,
    ranges: Sequence[str] | None = None,
) -> ProtocolScores:
    """Combine the errors of several data sets.

    Args:
        results: data set -> range -> error, for example `{"AV2": errors_by_range(scores)}`; NaN or None = no value.
        data_sets: those that must be there, for example `CHALLENGE_DATA_SETS`; None = those of `results`.
        ranges: those that every data set must have; None = every range that any data set has.

    Returns:
        Overall, per data set, per range: NaN for every mean that a hole enters, and the reasons in `missing`. A mean
        over fewer sets or ranges than asked for is never given.

    Raises:
        CFlowError: data sets or ranges that were not asked for; nothing to combine.
    """
    given = list(dict.fromkeys(name for row in results.values() for name in row))
    set_names = list(results if data_sets is None else data_sets)
    range_names = list(given if ranges is None else ranges)
    if not set_names or not range_names:
        raise CFlowError(f"nothing to combine: data sets {set_names}, ranges {range_names}")
    unknown = [name for name in (*results, *given) if name not in (*set_names, *range_names)]
    if unknown:
        raise CFlowError(f"{unknown} given, but only {set_names}, {range_names} asked for; leave out or ask for all")
    reasons: list[str] = []
    table: dict[str, list[float]] = {}
    for set_name in set_names:
        row = results.get(set_name, {})
        table[set_name] = [_number(row.get(name)) for name in range_names]
        for name, value in zip(range_names, table[set_name]):
            if math.isnan(value):
                why = "no moving points (NaN)" if name in row else "no result"
                reasons.append(f"data set {set_name}, range {name}: {why}")
    per_set = {name: fmean(row) for name, row in table.items()}  # NaN if any is NaN
    per_range = {name: fmean([row[i] for row in table.values()]) for i, name in enumerate(range_names)}
    return ProtocolScores(fmean(per_set.values()), per_set, per_range, tuple(reasons))


def _number(value: float | None) -> float:
    return math.nan if value is None else float(value)
