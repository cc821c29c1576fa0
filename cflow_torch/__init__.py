"""CorrelationFlow: training-free LiDAR scene flow as batched PyTorch."""

from cflow_torch.config import Config, make_config
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.estimate import estimate_flow, make_model
from cflow_torch.keypoints.method import CorrelationFlowKeypoints
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window

__version__ = "0.1.0"

__all__ = [
    "CFlowError",
    "Config",
    "CorrelationFlow",
    "CorrelationFlowKeypoints",
    "FlowResult",
    "Sweep",
    "Window",
    "estimate_flow",
    "make_config",
    "make_model",
    "__version__",
]
