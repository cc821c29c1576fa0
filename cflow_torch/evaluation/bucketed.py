"""Dynamic bucket-normalised end-point error: error divided by speed, averaged over speed buckets, per class."""

from __future__ import annotations

import warnings
from typing import Any, Dict, Tuple, Union

import numpy as np

from cflow_torch.data.categories import META_NAMES, meta_class
from cflow_torch.evaluation.accumulator import Accumulator
from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.masks import ScoredPoints


def mean_of_present(values: np.ndarray) -> float:
    """Mean of the values that are not NaN; NaN where there are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=RuntimeWarning)
        return float(np.nanmean(values)) if values.size else float("nan")


def bucket_cells(scored: ScoredPoints, definition: Definition) -> Tuple[np.ndarray, np.ndarray]:
    """Class and speed bucket of each point.

    Returns:
        (M,) int64, cell = class * number of buckets + bucket; (M,) bool, False where a point has no cell.
    """
    edges = np.asarray(definition.speed_edges)
    meta = meta_class(scored.category)
    bucket = np.searchsorted(edges, scored.speed, side="right") - 1
    if definition.background == "static":
        bucket = np.where(meta == META_NAMES.index("BACKGROUND"), 0, bucket)
    return meta * (len(edges) - 1) + bucket, (meta >= 0) & (bucket >= 0) & (bucket < len(edges) - 1)


def bucket_scores(count: np.ndarray, error_sum: np.ndarray, speed_sum: np.ndarray) -> Dict[str, Any]:
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
    mean = {
        key: mean_of_present(np.array([scores[key] for scores in classes.values()], dtype=np.float64))
        for key in ("static_epe", "dynamic_error")
    }
    return {"classes": classes, "mean": mean}


class BucketedEPE(Accumulator):
    """Streaming dynamic bucket-normalised EPE.

    With e and v the mean end-point error and mean true speed of all points of a class in a bucket, over all frames:
    `static_epe` = e of the first bucket in metres; `dynamic_error` = mean of e / v over the other buckets that have
    points, each bucket with the same weight. A prediction of "nothing moves" has a dynamic error of exactly 1.

    Args:
        definition: name or `Definition`.

    Convention: frames in any order; a bucket holds its lower edge, not its upper one; classes without points are NaN
    and do not enter the mean over classes.

    Cost: a few arrays of the size of one frame per update; memory (classes x buckets).
    """

    totals = ("count", "error_sum", "speed_sum")

    def __init__(self, definition: Union[str, Definition] = "opensceneflow") -> None:
        super().__init__(definition)
        shape = (len(META_NAMES), len(self.definition.speed_edges) - 1)
        self.count = np.zeros(shape, dtype=np.int64)
        self.error_sum = np.zeros(shape, dtype=np.float64)
        self.speed_sum = np.zeros(shape, dtype=np.float64)

    def update_points(self, scored: ScoredPoints) -> None:
        """Add the scored points of one frame."""
        cell, keep = bucket_cells(scored, self.definition)
        keep &= scored.in_region
        size, shape = self.count.size, self.count.shape
        self.count += np.bincount(cell[keep], minlength=size).reshape(shape)
        self.error_sum += np.bincount(cell[keep], scored.error[keep], minlength=size).reshape(shape)
        self.speed_sum += np.bincount(cell[keep], scored.speed[keep], minlength=size).reshape(shape)

    def compute(self) -> Dict[str, Any]:
        """Scores so far.

        Returns:
            "classes": per meta class `static_epe` (metres), `dynamic_error` (ratio), `num_static`, `num_dynamic`
            (points) and "buckets" (`count`, `epe`, `speed`, `normalized` per bucket); "mean": `static_epe`,
            `dynamic_error`; "speed_edges": metres per frame.
        """
        scores = bucket_scores(self.count, self.error_sum, self.speed_sum)
        return {**scores, "speed_edges": list(self.definition.speed_edges)}
