"""End-point error of static and dynamic points by distance from the sensor (the metric of SSF)."""

from __future__ import annotations

from typing import Any, Dict, Sequence, Tuple

import numpy as np

from cflow_torch.evaluation.accumulator import Accumulator
from cflow_torch.evaluation.bucketed import mean_of_present
from cflow_torch.evaluation.definitions import interval_of, range_names
from cflow_torch.evaluation.masks import ScoredPoints


class RangeWiseEPE(Accumulator):
    """Streaming range-wise EPE; the definition's region does not apply, every category counts.

    Convention: distance includes height; a range holds its lower edge, not its upper one; means are over all points
    of all frames; "mean" weighs every range that has points the same.
    """

    num_quantities = 1

    def shape(self) -> Tuple[int, ...]:
        """(ranges, static / dynamic)."""
        return len(self.definition.range_edges) - 1, 2

    def cells(self, scored: ScoredPoints) -> Tuple[np.ndarray, Sequence[np.ndarray]]:
        """Range and motion; error."""
        number = interval_of(scored.distance, self.definition.range_edges)
        # speed times rate, not divided by the interval: the product is what the harness compares
        dynamic = scored.speed * (1.0 / self.definition.sweep_interval) >= self.definition.range_dynamic_speed
        keep = number >= 0
        return (2 * number + dynamic)[keep], (scored.error[keep],)

    def compute(self) -> Dict[str, Any]:
        """Per range ("0-35", ...) `static_epe`, `dynamic_epe` in metres, `num_static`, `num_dynamic`; and "mean"."""
        with np.errstate(divide="ignore", invalid="ignore"):
            epe = self.sums[0] / self.count
        result: Dict[str, Any] = {
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
