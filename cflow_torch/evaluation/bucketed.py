"""Dynamic bucket-normalised end-point error: error divided by speed, averaged over speed buckets, per class or range.

And the plain end-point error of static and dynamic points by distance from the sensor (the metric of SSF).
"""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np

from cflow_torch.data.categories import META_NAMES, meta_class
from cflow_torch.evaluation.accumulator import Accumulator
from cflow_torch.evaluation.definitions import Definition, interval_of, range_names
from cflow_torch.evaluation.masks import ScoredPoints

_MEANS = ("static_epe", "dynamic_error")


def mean_of_present(values: np.ndarray) -> float:
    """Mean of the values that are not NaN; NaN where there are none."""
    count = (~np.isnan(values)).sum()
    return float(np.nansum(values) / count) if count else float("nan")


def bucket_cells(scored: ScoredPoints, definition: Definition) -> tuple[np.ndarray, np.ndarray]:
    """Class and speed bucket of each point.

    Returns:
        (M,) int64, cell = class * number of buckets + bucket; (M,) bool, False where a point has no cell.
    """
    meta, bucket = meta_class(scored.category), interval_of(scored.speed, definition.speed_edges)
    if definition.background == "static":
        bucket = np.where(meta == META_NAMES.index("BACKGROUND"), 0, bucket)
    return meta * (len(definition.speed_edges) - 1) + bucket, (meta >= 0) & (bucket >= 0)


def bucket_scores(count: np.ndarray, error_sum: np.ndarray, speed_sum: np.ndarray) -> dict[str, Any]:
    """Scores of (classes, buckets) sums: the "classes" and "mean" that `BucketedEPE.compute` returns."""
    with np.errstate(divide="ignore", invalid="ignore"):
        epe = error_sum / count
        speed = speed_sum / count
        normalized = np.concatenate([epe[:, :1], epe[:, 1:] / speed[:, 1:]], axis=1)
    classes = {
        name: {
            "static_epe": float(normalized[row, 0]),
            "dynamic_error": mean_of_present(normalized[row, 1:]),
            "num_static": int(count[row, 0]),
            "num_dynamic": int(count[row, 1:].sum()),
            "buckets": {
                "count": count[row].tolist(),
                "epe": epe[row].tolist(),
                "speed": speed[row].tolist(),
                "normalized": normalized[row].tolist(),
            },
        }
        for row, name in enumerate(META_NAMES)
    }
    mean = {key: mean_of_present(np.array([scores[key] for scores in classes.values()])) for key in _MEANS}
    return {"classes": classes, "mean": mean}


class BucketedEPE(Accumulator):
    """Streaming dynamic bucket-normalised EPE.

    With e and v the mean end-point error and mean true speed of all points of a class in a bucket, over all frames:
    `static_epe` = e of the first bucket in metres; `dynamic_error` = mean of e / v over the other buckets that have
    points, each bucket with the same weight. A prediction of "nothing moves" has a dynamic error of exactly 1.

    Convention: a bucket holds its lower edge, not its upper one; classes without points are NaN and do not enter the
    mean over classes.
    """

    def shape(self) -> tuple[int, ...]:
        """(classes, buckets)."""
        return len(META_NAMES), len(self.definition.speed_edges) - 1

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Class and bucket; error and speed."""
        cell, keep = bucket_cells(scored, self.definition)
        keep &= scored.in_region
        return cell[keep], (scored.error[keep], scored.speed[keep])

    def compute(self) -> dict[str, Any]:
        """Scores so far.

        Returns:
            "classes": per meta class `static_epe` (metres), `dynamic_error` (ratio), `num_static`, `num_dynamic`
            (points) and "buckets" (`count`, `epe`, `speed`, `normalized` per bucket); "mean": `static_epe`,
            `dynamic_error`; "speed_edges": metres per frame.
        """
        return {**bucket_scores(self.count, *self.sums), "speed_edges": list(self.definition.speed_edges)}


class BucketedByRange(Accumulator):
    """Streaming `BucketedEPE` of every range between the definition's `region_edges`, in one pass.

    Args:
        definition: name or `Definition`; its `region` ("box" or "disc"), `region_axes` and `closed` tell how a range is
            measured, its `max_range` does not apply.

    Convention: each point is in one range at most; a range's scores are those of a `BucketedEPE` of its points.
    """

    def shape(self) -> tuple[int, ...]:
        """(ranges, classes, buckets)."""
        return len(self.definition.region_edges) - 1, len(META_NAMES), len(self.definition.speed_edges) - 1

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Range, class and bucket; error and speed."""
        cell, keep = bucket_cells(scored, self.definition)
        number = interval_of(scored.reach, self.definition.region_edges, self.definition.closed)
        keep &= number >= 0
        return (number * self.count[0].size + cell)[keep], (scored.error[keep], scored.speed[keep])

    def compute(self) -> dict[str, Any]:
        """Scores so far.

        Returns:
            "ranges": "0-35", ... -> "classes" and "mean" as `BucketedEPE` gives them; "mean": `static_epe`,
            `dynamic_error`, mean over all ranges, NaN if a range has no points to score; "speed_edges".
        """
        names = range_names(self.definition.region_edges)
        ranges = {name: bucket_scores(*sums) for name, *sums in zip(names, self.count, *self.sums)}
        mean = {key: float(np.mean([scores["mean"][key] for scores in ranges.values()])) for key in _MEANS}
        return {"ranges": ranges, "mean": mean, "speed_edges": list(self.definition.speed_edges)}


class RangeWiseEPE(Accumulator):
    """Streaming range-wise EPE; the definition's region does not apply, every category counts.

    Convention: distance includes height; a range holds its lower edge, not its upper one; means are over all points
    of all frames; "mean" weighs every range that has points the same.
    """

    num_quantities = 1

    def shape(self) -> tuple[int, ...]:
        """(ranges, static / dynamic)."""
        return len(self.definition.range_edges) - 1, 2

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Range and motion; error."""
        number = interval_of(scored.distance, self.definition.range_edges)
        # speed times rate, not divided by the interval: the product is what the harness compares
        dynamic = scored.speed * (1.0 / self.definition.sweep_interval) >= self.definition.range_dynamic_speed
        keep = number >= 0
        return (2 * number + dynamic)[keep], (scored.error[keep],)

    def compute(self) -> dict[str, Any]:
        """Per range ("0-35", ...) `static_epe`, `dynamic_epe` in metres, `num_static`, `num_dynamic`; and "mean"."""
        with np.errstate(divide="ignore", invalid="ignore"):
            epe = self.sums[0] / self.count
        result: dict[str, Any] = {
            name: {
                "static_epe": float(epe[row, 0]),
                "dynamic_epe": float(epe[row, 1]),
                "num_static": int(self.count[row, 0]),
                "num_dynamic": int(self.count[row, 1]),
            }
            for row, name in enumerate(range_names(self.definition.range_edges))
        }
        result["mean"] = {"static_epe": mean_of_present(epe[:, 0]), "dynamic_epe": mean_of_present(epe[:, 1])}
        return result
