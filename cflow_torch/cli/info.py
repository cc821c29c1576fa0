"""Prints the versions of cflow_torch and of the packages that it uses, the system, the processor and the devices.

examples:
  cflow info         paste the whole output into a bug report
  cflow --version    prints the version only
"""

from __future__ import annotations

import re
from contextlib import suppress
from importlib import metadata
from pathlib import Path

from torch.utils.collect_env import get_pretty_env_info

import cflow_torch
from cflow_torch.errors import CFlowError


def task(arguments: list[str]) -> None:
    """Run `cflow info`."""
    if arguments:
        raise CFlowError(f"info takes no settings, got {' '.join(arguments)}: cflow info")
    print(f"cflow_torch {cflow_torch.__version__} in {Path(cflow_torch.__file__).parent}", flush=True)
    print(get_pretty_env_info())
    names = {re.split(r"[^\w.-]", text, maxsplit=1)[0] for text in _requirements()}
    for name in sorted(names - {"cflow_torch"}):
        try:
            print(name, metadata.version(name))
        except metadata.PackageNotFoundError:
            print(name, "not installed")


def _requirements() -> list[str]:
    with suppress(metadata.PackageNotFoundError):  # a checkout that is not installed
        return metadata.requires("cflow_torch") or []
    return []
