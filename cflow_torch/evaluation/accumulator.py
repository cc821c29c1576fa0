"""The base class of all metrics: sums per cell, added frame by frame, that can be merged."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np

from cflow_torch.evaluation.definitions import Definition
from cflow_torch.evaluation.scored_points import ScoredPoints


class Accumulator:
    """Counts points and sums their quantities per cell; frames come in any order.

    `count` is the int64 number of points of each cell, and `sums` has a float64 array of its shape per quantity.
    """

    def __init__(self, definition: Definition, shape: Sequence[int], num_quantities: int = 2) -> None:
        self.definition = definition
        self.count = np.zeros(shape, dtype=np.int64)
        self.sums = np.zeros((num_quantities, *shape), dtype=np.float64)

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return the flat cell of each scored point, (K,) int64, and its quantities, (K,) float64 each."""
        raise NotImplementedError

    def compute(self) -> dict[str, Any]:
        """Return the scores so far."""
        raise NotImplementedError

    def update_points(self, scored: ScoredPoints) -> None:
        """Add the scored points of one frame."""
        cell, quantities = self.cells(scored)
        size = self.count.size
        sums = np.stack([np.bincount(cell, values, minlength=size) for values in quantities])
        self._add(np.bincount(cell, minlength=size).reshape(self.count.shape), sums.reshape(self.sums.shape))

    def _add(self, count: np.ndarray, sums: np.ndarray) -> None:
        """Add the cells of one frame."""
        self.count += count
        self.sums += sums

    def merge(self, other: Accumulator) -> None:
        """Add the frames of another accumulator of the same kind and definition."""
        for name in vars(self).keys() - {"definition"}:
            setattr(self, name, getattr(self, name) + getattr(other, name))
