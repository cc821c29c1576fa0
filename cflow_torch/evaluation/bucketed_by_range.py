"""The dynamic bucket-normalised error of several rings or frames around the ego vehicle, in one pass."""

from __future__ import annotations

from typing import Any, Dict, Union

import numpy as np

from cflow_torch.data.categories import META_NAMES
from cflow_torch.evaluation.accumulator import Accumulator
from cflow_torch.evaluation.bucketed import bucket_cells, bucket_scores
from cflow_torch.evaluation.definitions import Definition, range_names
from cflow_torch.evaluation.masks import ScoredPoints


class BucketedByRange(Accumulator):
    """Streaming `BucketedEPE` of every range between the definition's `region_edges`.

    Args:
        definition: name or `Definition`; its `region` ("box" or "disc"), `region_axes` and `closed` tell how a range is
            measured, its `min_range` and `max_range` do not apply.

    Convention: each point is in one range at most; a range's scores are those of a `BucketedEPE` with that
    `min_range` and `max_range`.

    Cost: as `BucketedEPE`, whatever the number of ranges.
    """

    totals = ("count", "error_sum", "speed_sum")

    def __init__(self, definition: Union[str, Definition] = "challenge_2026") -> None:
        super().__init__(definition)
        ranges, buckets = len(self.definition.region_edges) - 1, len(self.definition.speed_edges) - 1
        shape = (ranges, len(META_NAMES), buckets)
        self.count = np.zeros(shape, dtype=np.int64)
        self.error_sum = np.zeros(shape, dtype=np.float64)
        self.speed_sum = np.zeros(shape, dtype=np.float64)

    def update_points(self, scored: ScoredPoints) -> None:
        """Add the scored points of one frame."""
        cell, keep = bucket_cells(scored, self.definition)
        number = self._range_of(scored.reach)
        keep &= (number >= 0) & (number < len(self.count))
        size, shape = self.count.size, self.count.shape
        cell = (number * self.count[0].size + cell)[keep]
        self.count += np.bincount(cell, minlength=size).reshape(shape)
        self.error_sum += np.bincount(cell, scored.error[keep], minlength=size).reshape(shape)
        self.speed_sum += np.bincount(cell, scored.speed[keep], minlength=size).reshape(shape)

    def compute(self) -> Dict[str, Any]:
        """Scores so far.

        Returns:
            "ranges": "0-35", ... -> "classes" and "mean" as `BucketedEPE` gives them; "mean": `static_epe`,
            `dynamic_error`, mean over all ranges, NaN if a range has no points to score; "speed_edges".
        """
        sums = zip(self.count, self.error_sum, self.speed_sum)
        ranges = {name: bucket_scores(*parts) for name, parts in zip(range_names(self.definition.region_edges), sums)}
        mean = {
            key: float(np.mean([scores["mean"][key] for scores in ranges.values()]))
            for key in ("static_epe", "dynamic_error")
        }
        return {"ranges": ranges, "mean": mean, "speed_edges": list(self.definition.speed_edges)}

    def _range_of(self, reach: np.ndarray) -> np.ndarray:
        """(M,) number of the range; outside 0 ... number of ranges - 1 where a point is in none."""
        edges = np.asarray(self.definition.region_edges)
        if not self.definition.closed:
            return np.searchsorted(edges, reach, side="right") - 1
        number = np.searchsorted(edges, reach, side="left") - 1
        return np.maximum(number, 0) if edges[0] == 0 else number  # the origin itself belongs to the first range
