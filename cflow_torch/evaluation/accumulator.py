"""The base class of all metrics: sums per cell, added frame by frame, that can be merged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Sequence

import numpy as np

from cflow_torch.evaluation.definitions import Definition, get_definition
from cflow_torch.evaluation.scored_points import ScoredPoints
from cflow_torch.types import CFlowError


class Accumulator(ABC):
    """Counts points and sums their values per cell; frames come in any order.

    `count` is the int64 number of points of each cell, and `sums` has a float64 array of its shape per quantity.
    """

    totals: tuple[str, ...] = ("count", "sums")  # attributes that add up over frames
    num_quantities = 2  # of each point

    def __init__(self, definition: str | Definition = "opensceneflow") -> None:
        self.definition = get_definition(definition)
        self.count = np.zeros(self.shape(), dtype=np.int64)
        self.sums = np.zeros((self.num_quantities, *self.shape()), dtype=np.float64)

    @abstractmethod
    def shape(self) -> tuple[int, ...]:
        """Return the number of cells along each axis."""

    @abstractmethod
    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return the flat cell of each scored point, (K,) int64, and its quantities, (K,) float64 each."""

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
        """Add the frames of another accumulator; a `CFlowError` if it has another kind or definition."""
        if type(other) is not type(self) or other.definition != self.definition:
            raise CFlowError(f"cannot merge scores of {other.definition.name} into {self.definition.name}")
        for name in self.totals:
            setattr(self, name, getattr(self, name) + getattr(other, name))
