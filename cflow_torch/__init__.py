"""CorrelationFlow: training-free LiDAR scene flow as batched PyTorch."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cflow_torch.applications.cleaning import CleanLog, static_map
    from cflow_torch.applications.stream import FlowStream
    from cflow_torch.applications.tracking import Tracker, track
    from cflow_torch.config import Config, make_config
    from cflow_torch.dense.method import CorrelationFlow
    from cflow_torch.estimate import estimate_flow, make_model
    from cflow_torch.keypoints.method import CorrelationFlowKeypoints
    from cflow_torch.types import CFlowError, FlowResult, Sweep, Window
    from cflow_torch.verified.method import VerifiedFlow

__version__ = "0.3.0"

__all__ = [
    "CFlowError",
    "CleanLog",
    "Config",
    "CorrelationFlow",
    "CorrelationFlowKeypoints",
    "FlowResult",
    "FlowStream",
    "Sweep",
    "Tracker",
    "VerifiedFlow",
    "Window",
    "estimate_flow",
    "make_config",
    "make_model",
    "static_map",
    "track",
    "__version__",
]

# Where each name is. It is imported when it is first asked for: torch takes seconds, which `cflow --version` need not.
_MODULES = {
    "CFlowError": "types",
    "CleanLog": "applications.cleaning",
    "Config": "config",
    "CorrelationFlow": "dense.method",
    "CorrelationFlowKeypoints": "keypoints.method",
    "FlowResult": "types",
    "FlowStream": "applications.stream",
    "Sweep": "types",
    "Tracker": "applications.tracking",
    "VerifiedFlow": "verified.method",
    "Window": "types",
    "estimate_flow": "estimate",
    "make_config": "config",
    "make_model": "estimate",
    "static_map": "applications.cleaning",
    "track": "applications.tracking",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
