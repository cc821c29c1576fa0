"""Dynamic bucket-normalised end-point error, per class or range, and the range-wise end-point error of SSF.

The first divides the error by the speed and averages over speed buckets. The second is the mean error, in metres, of
static and of dynamic points per interval of distance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Sequence

import numpy as np

from cflow_torch.data.categories import META_NAMES, meta_class
from cflow_torch.evaluation.definitions import Definition, interval_of, range_names
from cflow_torch.evaluation.scored_points import Accumulator, ScoredPoints

_MEANS = ("static_epe", "dynamic_error")
_RANGE_EDGES = (0.0, 35.0, 50.0, 75.0, 100.0, np.inf)  # metres, of the range-wise error
_RANGE_DYNAMIC_SPEED = 1.4  # m/s, least speed of a dynamic point in the range-wise error


def mean_of_present(values: np.ndarray) -> float:
    """Average the values that are not NaN; NaN if there are none."""
    count = (~np.isnan(values)).sum()
    return float(np.nansum(values) / count) if count else float("nan")


def bucket_scores(count: np.ndarray, error_sum: np.ndarray, speed_sum: np.ndarray) -> dict[str, Any]:
    """Compute "classes" and "mean" of `BucketedEPE.compute` from sums of shape (classes, buckets)."""
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


class BucketedByRange(Accumulator):
    """Dynamic bucket-normalised EPE of each range between the definition's `region_edges`, see `BucketedEPE`.

    `region` ("box" or "disc"), `region_axes` and `closed` define how a range is measured; `max_range` does not apply. A
    point is in at most one range.
    """

    def __init__(self, definition: Definition) -> None:
        shape = len(definition.region_edges) - 1, len(META_NAMES), len(definition.speed_edges) - 1
        super().__init__(definition, shape)

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return the cell (range, class, bucket) of each scored point, and its two quantities: error and speed."""
        ranges = interval_of(scored.reach, self.definition.region_edges, self.definition.closed)
        meta = meta_class(scored.category)
        bucket = interval_of(scored.speed, self.definition.speed_edges)
        if self.definition.background == "static":
            bucket = np.where(meta == META_NAMES.index("BACKGROUND"), 0, bucket)
        place = np.stack([ranges, meta, bucket])
        keep = (place >= 0).all(axis=0)
        cell = np.ravel_multi_index(tuple(place[:, keep]), self.count.shape)
        return cell, (scored.error[keep], scored.speed[keep])

    def compute(self) -> dict[str, Any]:
        """Return "ranges", "mean" and "speed_edges".

        "ranges" has a dictionary for each range ("0-35", ...), with "classes" and "mean" as in `BucketedEPE`. "mean"
        has the means of `static_epe` and of `dynamic_error` over the ranges, NaN if a range has no points to score.
        """
        names = range_names(self.definition.region_edges)
        ranges = {name: bucket_scores(*sums) for name, *sums in zip(names, self.count, *self.sums)}
        mean = {key: float(np.mean([scores["mean"][key] for scores in ranges.values()])) for key in _MEANS}
        return {"ranges": ranges, "mean": mean, "speed_edges": list(self.definition.speed_edges)}


class BucketedEPE(BucketedByRange):
    """Dynamic bucket-normalised EPE of the definition's region.

    Let e and v be the mean end-point error and the mean true speed of all points of a class in a bucket, over all
    frames. `static_epe` is e of the first bucket, in metres. `dynamic_error` is the mean of e / v over the other
    buckets that have points. It is exactly 1 if every residual is predicted as 0. A bucket contains its lower edge, not
    its upper one. Classes without points are NaN and are not part of the mean over classes.
    """

    def __init__(self, definition: Definition) -> None:
        super().__init__(replace(definition, region_edges=(0.0, definition.max_range)))

    def compute(self) -> dict[str, Any]:
        """Return "classes", "mean" and "speed_edges" (metres per frame).

        Each class has `static_epe` (metres), `dynamic_error` (ratio), `num_static` and `num_dynamic` (points), and
        "buckets", the lists `count`, `epe`, `speed` and `normalized`. "mean" has the first two, averaged over classes.
        """
        return {**bucket_scores(self.count[0], *self.sums[:, 0]), "speed_edges": list(self.definition.speed_edges)}


class RangeWiseEPE(Accumulator):
    """Range-wise EPE of all categories. The definition's region does not apply.

    Convention: distance includes height. A range contains its lower edge, not its upper one. Means are over all points
    of all frames; "mean" gives every range that has points the same weight.
    """

    def __init__(self, definition: Definition) -> None:
        super().__init__(definition, (len(_RANGE_EDGES) - 1, 2), num_quantities=1)

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return the cell (range, motion) of each scored point, and one quantity: the error."""
        ring = interval_of(scored.distance, _RANGE_EDGES)
        # We multiply by the rate, as OpenSceneFlow does: a division rounds differently at the threshold.
        dynamic = scored.speed * (1.0 / self.definition.sweep_interval) >= _RANGE_DYNAMIC_SPEED
        keep = ring >= 0
        return (2 * ring + dynamic)[keep], (scored.error[keep],)

    def compute(self) -> dict[str, Any]:
        """Return `static_epe`, `dynamic_epe` (metres), `num_static`, `num_dynamic` of each range, and their "mean"."""
        with np.errstate(divide="ignore", invalid="ignore"):
            epe = self.sums[0] / self.count
        result: dict[str, Any] = {
            name: {
                "static_epe": float(epe[row, 0]),
                "dynamic_epe": float(epe[row, 1]),
                "num_static": int(self.count[row, 0]),
                "num_dynamic": int(self.count[row, 1]),
            }
            for row, name in enumerate(range_names(_RANGE_EDGES))
        }
        result["mean"] = {"static_epe": mean_of_present(epe[:, 0]), "dynamic_epe": mean_of_present(epe[:, 1])}
        return result
