"""Print versions and environment for a bug report: `cflow info`."""

from __future__ import annotations

import os
import platform
import re
from contextlib import suppress
from importlib import metadata
from pathlib import Path

import cflow_torch
from cflow_torch.errors import CFlowError


def task(arguments: list[str]) -> None:
    if arguments:
        raise CFlowError(f"info takes nothing, got {' '.join(arguments)}: cflow info")
    print(f"cflow_torch {cflow_torch.__version__} in {Path(cflow_torch.__file__).parent}")
    print(f"Python {platform.python_version()} on {platform.platform()}")
    print(f"processor {processor()}, cores {os.cpu_count()}")
    for file in sorted(Path("/proc/driver/nvidia/gpus").glob("*/information")):  # of NVIDIA's driver for Linux
        print("GPU", file.read_text().partition("\n")[0].partition(":")[2].strip())
    missing = []
    for name in sorted(_requirements() - {"cflow_torch"}):
        try:
            print(name, metadata.version(name))
        except metadata.PackageNotFoundError:
            missing.append(name)
    print("not installed:", ", ".join(missing) or "nothing")


def processor() -> str:
    with suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:
        for line in file:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def _requirements() -> set[str]:
    """Return the names of the packages that the core and the extras need; none if this package is not installed."""
    with suppress(metadata.PackageNotFoundError):
        return {re.split(r"[^\w.-]", text, maxsplit=1)[0] for text in metadata.requires("cflow_torch") or []}
    return set()
