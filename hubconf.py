"""Entry points of `torch.hub`: `torch.hub.load("/path/to/cflow_torch", "cflow", source="local")`.

Nothing is downloaded: the method has no weights. A checkout is enough, the package need not be installed.
"""

from __future__ import annotations

from typing import Any as _Any  # underscores: not entry points

from torch.nn import Module as _Module

from cflow_torch import make_model as _make_model

dependencies = ["torch", "numpy"]


def cflow(preset: str = "default", device: _Any = "auto", **settings: _Any) -> _Module:
    """A method as a module without parameters: a list of `cflow_torch.Window` in, a list of `FlowResult` out.

    Args:
        preset: "default", "offline", "live", "keypoints", "paper" or "paper_keypoints".
        device: "auto" = that of the tensors given, else a GPU if there is one, else the CPU.
        **settings: any field of the preset's method, for example `num_history=2`.

    Raises:
        CFlowError: an unknown preset or setting, or an invalid value.
    """
    return _make_model(preset, device, **settings)
