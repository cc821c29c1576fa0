"""Intersection over union of moving points, the score of moving object segmentation."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np

from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.scored_points import Accumulator, ScoredPoints


class MovingIoU(Accumulator):
    """IoU of the points that truly move and of those that are predicted to move, over all points of all frames.

    Frames say which points are predicted to move (`FlowResult.is_moving`). Otherwise, these are the points whose
    residual flow is at least `dynamic_threshold`.
    """

    def __init__(self, definition: Definition) -> None:
        super().__init__(definition, (2,), num_quantities=1)

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return 1 for each scored point that truly moves, else 0; the quantity is 1 if it is predicted to move."""
        keep = scored.in_region
        return scored.is_dynamic[keep].astype(np.int64), (scored.predicted_dynamic[keep].astype(np.float64),)

    def compute(self) -> dict[str, Any]:
        """Return `iou`, `precision` and `recall` of moving points, and `num_moving`, `num_predicted`, `num_points`.

        A ratio is NaN if there are no points to divide by.
        """
        num_moving = int(self.count[1])
        num_predicted = int(self.sums[0].sum())
        both = int(self.sums[0, 1])
        return {
            "iou": _ratio(both, num_moving + num_predicted - both),
            "precision": _ratio(both, num_predicted),
            "recall": _ratio(both, num_moving),
            "num_moving": num_moving,
            "num_predicted": num_predicted,
            "num_points": int(self.count.sum()),
        }


def _ratio(count: int, of: int) -> float:
    return count / of if of else float("nan")
