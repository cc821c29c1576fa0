"""Training-free LiDAR scene flow in batched PyTorch: CorrelationFlow and VerifiedFlow."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cflow_torch.applications.cleaning import CleanLog as CleanLog
    from cflow_torch.applications.cleaning import static_map as static_map
    from cflow_torch.applications.stream import FlowStream as FlowStream
    from cflow_torch.applications.tracking import Tracker as Tracker
    from cflow_torch.applications.tracking import track as track
    from cflow_torch.config import Config as Config
    from cflow_torch.config import make_config as make_config
    from cflow_torch.data.catalog import open as open
    from cflow_torch.dense.method import CorrelationFlow as CorrelationFlow
    from cflow_torch.errors import CFlowError as CFlowError
    from cflow_torch.estimate import estimate_flow as estimate_flow
    from cflow_torch.estimate import make_model as make_model
    from cflow_torch.keypoints.method import CorrelationFlowKeypoints as CorrelationFlowKeypoints
    from cflow_torch.types import FlowResult as FlowResult
    from cflow_torch.types import Sweep as Sweep
    from cflow_torch.types import Window as Window
    from cflow_torch.verified.method import VerifiedFlow as VerifiedFlow

__version__ = "0.4.0"

# The module of each name. We import it on first use, because torch takes seconds that `cflow --version` does not need.
_MODULES = {
    "CFlowError": "errors",
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
    "open": "data.catalog",
    "static_map": "applications.cleaning",
    "track": "applications.tracking",
}
# `from cflow_torch import *` must not hide Python's own `open`.
__all__ = [*(name for name in _MODULES if name != "open"), "__version__"]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
