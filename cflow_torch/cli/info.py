"""What a bug report needs: version and commit, Python, packages and whether they load, processor, memory, devices.

Prints it; leaves nothing. A package that is installed but cannot be imported is named with its error.

examples:
  cflow info                 paste all of it into the report
  cflow --version            the version alone
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from importlib import import_module, metadata
from pathlib import Path
from typing import Dict, Iterator, List

import torch

import cflow_torch
from cflow_torch.types import CFlowError

# Distributions whose module has another name.
_MODULES = {
    "hydra-core": "hydra",
    "hydra-joblib-launcher": "hydra_plugins.hydra_joblib_launcher",
    "hydra-optuna-sweeper": "hydra_plugins.hydra_optuna_sweeper",
    "hydra-submitit-launcher": "hydra_plugins.hydra_submitit_launcher",
    "opencv-python-headless": "cv2",
    "rerun-sdk": "rerun",
    "universal-pathlib": "upath",
}
_CORE = ("torch", "numpy", "pyarrow", "kornia", "hydra-core", "tqdm")
_NATIVE = ("kornia-rs", "pillow")  # what packages above load, and fail with
_DEVELOPMENT = ("test", "dev", "notebooks")  # extras that no command needs


def task(arguments: List[str]) -> None:
    """Run `cflow info`."""
    if arguments:
        raise CFlowError(f"info takes no settings, got {' '.join(arguments)}: cflow info")
    for line in report():
        print(line, flush=True)


def report() -> Iterator[str]:
    """The lines."""
    package = Path(cflow_torch.__file__).parent
    yield f"cflow_torch {cflow_torch.__version__}{_commit(package.parent)} in {package}"
    yield f"settings in {', '.join(_configs())}"
    yield f"python {platform.python_version()} {sys.executable}, {platform.platform()}"
    yield f"torch {torch.__version__}, built for CUDA {torch.version.cuda}, {torch.get_num_threads()} threads"
    yield f"processor {platform.machine()} {_cpu_capability()}, {_cores()}, {_memory()}"
    variables = ("OMP_NUM_THREADS", "CUDA_VISIBLE_DEVICES", "CFLOW_CACHE", "HYDRA_FULL_ERROR")
    yield "environment " + (", ".join(f"{n}={os.environ[n]}" for n in variables if n in os.environ) or "plain")
    yield from _devices()
    for extra, names in _requirements().items():
        yield f"{extra}:"
        for name in names:
            yield f"  {_state(name)}"


def _requirements() -> Dict[str, List[str]]:
    """What the package asks for: "needed" and each extra of its own -> names of distributions."""
    try:
        asked = metadata.requires("cflow_torch") or []
    except metadata.PackageNotFoundError:
        return {"needed (cflow_torch itself is not installed, so its extras are not known)": list(_CORE)}
    found: Dict[str, List[str]] = {"needed": []}
    for text in asked:
        name = re.split(r"[^\w.-]", text, maxsplit=1)[0].lower().replace("_", "-")
        extra = re.search(r"extra\s*==\s*['\"]([\w-]+)['\"]", text)
        if extra is None:
            found["needed"].append(name)
        elif extra[1] not in _DEVELOPMENT and name not in found.setdefault(f"extra {extra[1]}", []):
            found[f"extra {extra[1]}"].append(name)
    found["native parts"] = list(_NATIVE)
    return found


def _state(name: str) -> str:
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} not installed"
    module = {"pillow": "PIL.Image"}.get(name) or _MODULES.get(name, name.replace("-", "_"))
    try:
        import_module(module)
    except Exception as error:  # whatever a foreign package raises
        return f"{name} {version} CANNOT BE IMPORTED: {type(error).__name__}: {' '.join(str(error).split())}"
    return f"{name} {version}"


def _commit(folder: Path) -> str:
    """ " (commit 1234abc, changed)" in a checkout."""
    if not (folder / ".git").exists():
        return ""
    try:
        command = ["git", "-C", str(folder), "describe", "--always", "--dirty=, changed", "--exclude=*"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return " (a checkout; git does not answer)"
    return f" (commit {done.stdout.strip()})" if done.returncode == 0 else " (a checkout; git does not answer)"


def _configs() -> List[str]:
    import cflow_torch.configs

    return list(cflow_torch.configs.__path__)


def _cpu_capability() -> str:
    find = getattr(torch.backends.cpu, "get_cpu_capability", None) if hasattr(torch.backends, "cpu") else None
    return find() if find is not None else ""


def _cores() -> str:
    count = os.cpu_count()
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else count
    return f"{count} cores" if usable == count else f"{count} cores, {usable} of them usable"


def _memory() -> str:
    try:
        return f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 2**30:.1f} GiB of memory"
    except (AttributeError, ValueError, OSError):
        return "memory not known"


def _devices() -> Iterator[str]:
    if not torch.cuda.is_available():
        yield "no GPU: everything runs on the CPU"
        return
    for index in range(torch.cuda.device_count()):
        about = torch.cuda.get_device_properties(index)
        memory = f"{about.total_memory / 2**30:.1f} GiB"
        yield f"cuda:{index} {about.name}, compute capability {about.major}.{about.minor}, {memory}"
