"""What every metric shares: scored points go in frame by frame, parts that were scored apart are merged."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Tuple, Union

from cflow_torch.evaluation.definitions import Definition, get_definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.masks import ScoredPoints, score_points
from cflow_torch.types import CFlowError


class Accumulator(ABC):
    """Sums over frames in any order.

    Args:
        definition: name or `Definition`.
    """

    totals: Tuple[str, ...] = ()
    """Names of the attributes that add up over frames."""

    def __init__(self, definition: Union[str, Definition] = "opensceneflow") -> None:
        self.definition = get_definition(definition)

    def update(self, frame: EvalFrame) -> None:
        """Add one frame."""
        self.update_points(score_points(frame, self.definition))

    @abstractmethod
    def update_points(self, scored: ScoredPoints) -> None:
        """Add the scored points of one frame."""

    def merge(self, other: Accumulator) -> None:
        """Add what another accumulator of the same kind and definition has seen.

        Raises:
            CFlowError: the kinds or definitions differ.
        """
        if type(other) is not type(self) or other.definition != self.definition:
            raise CFlowError(f"cannot merge scores of {other.definition.name} into {self.definition.name}")
        for name in self.totals:
            setattr(self, name, getattr(self, name) + getattr(other, name))
