"""Scores: dynamic bucket-normalised, three-way and range-wise end-point error, as the public evaluators define them."""

from cflow_torch.evaluation.bucketed import BucketedByRange, BucketedEPE
from cflow_torch.evaluation.definitions import DEFINITIONS, Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.protocol import ProtocolScores, errors_by_range, score_data_sets
from cflow_torch.evaluation.rangewise import RangeWiseEPE
from cflow_torch.evaluation.tables import format_table
from cflow_torch.evaluation.threeway import ThreeWayEPE

__all__ = [
    "DEFINITIONS",
    "BucketedByRange",
    "BucketedEPE",
    "Definition",
    "EvalFrame",
    "ProtocolScores",
    "RangeWiseEPE",
    "SceneFlowMetrics",
    "ThreeWayEPE",
    "errors_by_range",
    "format_table",
    "score_data_sets",
]
