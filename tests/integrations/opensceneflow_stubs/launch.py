"""Runs an unmodified script of OpenSceneFlow on a machine without GPU: python launch.py SCRIPT [arguments].

The current folder is the checkout. Only what cannot be imported is stood in for, so in the harness's own environment
nothing is. With OSF_CPU_RUNNER=1 the runner for methods without training, which asks for CUDA and NCCL, gets the CPU.
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
import tempfile
import types
from typing import Any, Callable


def _compiled(*arguments: Any, **settings: Any) -> None:
    raise RuntimeError("a stand-in for a compiled extension was called: this run is for CorrelationFlow only")


def _stand_ins() -> dict[str, dict[str, Any]]:
    """Module -> what the harness takes from it when it is imported."""
    voxels = ("dynamic_voxelize_forward", "hard_voxelize_forward")
    scatter = ("dynamic_point_to_voxel_forward", "dynamic_point_to_voxel_backward")
    return {
        "torchvision": {"transforms": types.SimpleNamespace(Compose=list)},
        "wandb": {"finish": lambda: None},
        "chamfer3D": {"forward": _compiled, "backward": _compiled},
        "mmcv": dict.fromkeys(voxels + scatter, _compiled),
    }


def add_stand_ins() -> None:
    """For every module that cannot be imported, one that can. Lightning comes first: it looks for the real ones."""
    import lightning.pytorch  # noqa: F401
    import numpy as np

    if not hasattr(np, "NaN"):  # gone since NumPy 2
        np.NaN = np.nan
    for name, contents in _stand_ins().items():
        try:
            importlib.import_module(name)
        except (ImportError, RuntimeError):  # RuntimeError: a torchvision that is not of this torch
            sys.modules[name] = types.ModuleType(name)
            sys.modules[name].__dict__.update(contents)


class _TorchOnCPU:
    """`torch` as the runner sees it: every device is the CPU."""

    def __init__(self, torch: Any) -> None:
        self._torch = torch

    def __getattr__(self, name: str) -> Any:
        return getattr(self._torch, name)

    def device(self, name: str) -> Any:
        return self._torch.device("cpu")


def give_runner_the_cpu() -> None:
    """Let `src.runner` run in this process, alone in a gloo group."""
    import torch.distributed as dist

    sys.path.insert(0, os.getcwd())
    runner = importlib.import_module("src.runner")

    def join_group() -> tuple[int, int]:
        file = tempfile.NamedTemporaryFile(prefix="gloo", delete=False).name  # noqa: SIM115
        dist.init_process_group("gloo", init_method=f"file://{file}", rank=0, world_size=1)
        return 0, 1

    def launch(cfg: Any, mode: str, *output_dir: str) -> None:
        run: Callable[[Any, str], None] = runner._run_process
        run(cfg, mode)

    runner.torch = _TorchOnCPU(runner.torch)
    runner._setup_distributed_environment = join_group
    runner.launch_runner = launch


if __name__ == "__main__":
    add_stand_ins()
    if os.environ.get("OSF_CPU_RUNNER") == "1":
        give_runner_the_cpu()
    sys.argv = sys.argv[1:]
    sys.path[0] = os.getcwd()  # as if the script had been started itself
    runpy.run_path(sys.argv[0], run_name="__main__")
