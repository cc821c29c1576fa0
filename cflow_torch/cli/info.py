"""Versions and devices, to paste into a bug report."""

from __future__ import annotations

import os
import platform
from importlib import metadata

import torch

PACKAGES = ("cflow_torch", "numpy", "pyarrow", "kornia", "hydra-core", "matplotlib", "opencv-python-headless")


def task() -> None:
    """Run `cflow info`."""
    print(f"python {platform.python_version()}, {platform.platform()}, {os.cpu_count()} cores")
    print(f"torch {torch.__version__}")  # its metadata leaves out the build
    for package in PACKAGES:
        try:
            print(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            print(f"{package} not installed")
    if torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            print(f"cuda:{index} {torch.cuda.get_device_name(index)}")
    else:
        print("no GPU: everything runs on the CPU, with the same results")
