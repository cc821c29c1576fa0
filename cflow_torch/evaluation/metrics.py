"""All metrics of one definition, fed frame by frame."""

from __future__ import annotations

from typing import Any, Callable

from cflow_torch.evaluation.accumulator import Accumulator
from cflow_torch.evaluation.bucketed import BucketedByRange, BucketedEPE, RangeWiseEPE
from cflow_torch.evaluation.definitions import Definition, get_definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.masks import score_points
from cflow_torch.evaluation.threeway import ThreeWayEPE

_ACCUMULATORS: dict[str, Callable[..., Accumulator]] = {
    "bucketed": BucketedEPE,
    "bucketed_by_range": BucketedByRange,
    "three_way": ThreeWayEPE,
    "range_wise": RangeWiseEPE,
}


class SceneFlowMetrics:
    """Every metric that a definition names, as one accumulator.

    Args:
        definition: a name in `DEFINITIONS` ("opensceneflow", "bucketed_scene_flow_eval", "av2", ...) or a
            `Definition`.

    Convention: frames in any order; `merge` joins parts that were scored apart.
    """

    def __init__(self, definition: str | Definition = "opensceneflow") -> None:
        self.definition = get_definition(definition)
        self.parts: dict[str, Any] = {name: _ACCUMULATORS[name](self.definition) for name in self.definition.metrics}
        self.num_frames = 0
        self.num_points = 0
        self.num_nan = 0

    def update(self, frame: EvalFrame) -> None:
        """Add one frame.

        Raises:
            CFlowError: NaN where the definition refuses it; the frame lacks `T_ego1_ego0` and the definition needs it.
        """
        scored = score_points(frame, self.definition)
        for part in self.parts.values():
            part.update_points(scored)
        self.num_frames += 1
        self.num_points += len(scored.error)
        self.num_nan += scored.num_nan

    def merge(self, other: SceneFlowMetrics) -> None:
        """Add what another accumulator of the same definition has seen.

        Raises:
            CFlowError: the definitions differ.
        """
        for part, another in zip(self.parts.values(), other.parts.values()):
            part.merge(another)
        self.num_frames += other.num_frames
        self.num_points += other.num_points
        self.num_nan += other.num_nan

    def compute(self) -> dict[str, Any]:
        """Nested dictionary of plain numbers: "definition", `num_frames`, `num_points`, `num_nan`, and each metric."""
        return {
            "definition": self.definition.name,
            "num_frames": self.num_frames,
            "num_points": self.num_points,
            "num_nan": self.num_nan,
            **{name: part.compute() for name, part in self.parts.items()},
        }
