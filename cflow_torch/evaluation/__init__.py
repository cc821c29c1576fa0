"""Scores: dynamic bucket-normalised, three-way and range-wise end-point error, as the public evaluators define them."""

from cflow_torch.evaluation.definitions import DEFINITIONS, Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import ProtocolScores, SceneFlowMetrics, errors_by_range, score_data_sets
from cflow_torch.evaluation.tables import format_table

__all__ = [
    "DEFINITIONS",
    "Definition",
    "EvalFrame",
    "ProtocolScores",
    "SceneFlowMetrics",
    "errors_by_range",
    "format_table",
    "score_data_sets",
]
