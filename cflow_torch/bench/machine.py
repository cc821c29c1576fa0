"""What the figures of a benchmark depend on besides the code."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path
from typing import Any, Dict

import torch

from cflow_torch.bench.opencv_loop import opencv
from cflow_torch.types import CFlowError

_PACKAGES = ("torch", "numpy", "kornia")


def describe_machine(threads: int, device: torch.device) -> Dict[str, Any]:
    """Processor, threads, device and versions, ready for JSON."""
    return {
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": threads,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
        "python": platform.python_version(),
        "versions": {
            **{package: _version(package) for package in _PACKAGES},
            "opencv": opencv().__version__ if has_opencv() else "not installed",
        },
    }


def has_opencv() -> bool:
    """Whether OpenCV can be imported."""
    try:
        opencv()
    except CFlowError:
        return False
    return True


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "unknown"
