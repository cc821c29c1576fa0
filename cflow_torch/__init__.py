"""CorrelationFlow: training-free LiDAR scene flow as batched PyTorch."""

from cflow_torch.config import Config, make_config
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.estimate import estimate_flow, make_model
from cflow_torch.keypoints.method import CorrelationFlowKeypoints
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window
from cflow_torch.verified.method import VerifiedFlow

__version__ = "0.2.0"

__all__ = [
    "CFlowError",
    "Config",
    "CorrelationFlow",
    "CorrelationFlowKeypoints",
    "FlowResult",
    "Sweep",
    "VerifiedFlow",
    "Window",
    "estimate_flow",
    "make_config",
    "make_model",
    "__version__",
]
