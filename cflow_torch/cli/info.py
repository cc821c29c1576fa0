"""What a bug report needs: version, system, Python, processor, devices; every package and whether it loads.

Prints it; leaves nothing. A package that is installed but cannot be imported is named with its error.

examples:
  cflow info                 paste all of it into the report
  cflow --version            the version alone
"""

from __future__ import annotations

import re
from importlib import import_module, metadata
from pathlib import Path

from torch.utils.collect_env import get_pretty_env_info

import cflow_torch
from cflow_torch.types import CFlowError

# Distributions whose module has another name.
_MODULES = {
    "hydra-core": "hydra",
    "hydra-joblib-launcher": "hydra_plugins.hydra_joblib_launcher",
    "hydra-optuna-sweeper": "hydra_plugins.hydra_optuna_sweeper",
    "hydra-submitit-launcher": "hydra_plugins.hydra_submitit_launcher",
    "opencv-python-headless": "cv2",
    "pillow": "PIL.Image",
    "pyyaml": "yaml",
    "rerun-sdk": "rerun",
    "scikit-learn": "sklearn",
    "universal-pathlib": "upath",
}
_NATIVE = ("kornia-rs", "pillow")  # what packages load, and fail with
_DEVELOPMENT = re.compile(r"extra\s*==\s*['\"](test|dev|notebooks)")  # extras that no command needs


def task(arguments: list[str]) -> None:
    """Run `cflow info`."""
    if arguments:
        raise CFlowError(f"info takes no settings, got {' '.join(arguments)}: cflow info")
    print(f"cflow_torch {cflow_torch.__version__} in {Path(cflow_torch.__file__).parent}", flush=True)
    print(get_pretty_env_info(), flush=True)
    try:
        asked = [text for text in metadata.requires("cflow_torch") or [] if not _DEVELOPMENT.search(text)]
    except metadata.PackageNotFoundError:
        print("cflow_torch is not installed, so what it asks for is not known")
        asked = []
    names = [re.split(r"[^\w.-]", text, maxsplit=1)[0].lower().replace("_", "-") for text in asked]
    for name in dict.fromkeys([*names, *_NATIVE]):
        if name == "cflow-torch":  # its own extras
            continue
        print(_state(name), flush=True)


def _state(name: str) -> str:
    try:
        version = metadata.version(name)
        import_module(_MODULES.get(name, name.replace("-", "_")))
    except metadata.PackageNotFoundError:
        return f"{name} not installed"
    except Exception as error:  # whatever a foreign package raises
        return f"{name} {version} CANNOT BE IMPORTED: {type(error).__name__}: {' '.join(str(error).split())}"
    return f"{name} {version}"
