"""Scores: dynamic bucket-normalised, three-way and range-wise end-point error, as the public evaluators define them."""

from cflow_torch.evaluation.bucketed import BucketedEPE
from cflow_torch.evaluation.definitions import DEFINITIONS, Definition
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.evaluation.rangewise import RangeWiseEPE
from cflow_torch.evaluation.tables import format_table
from cflow_torch.evaluation.threeway import ThreeWayEPE

__all__ = [
    "DEFINITIONS",
    "BucketedEPE",
    "Definition",
    "EvalFrame",
    "RangeWiseEPE",
    "SceneFlowMetrics",
    "ThreeWayEPE",
    "format_table",
]
