"""Run an unmodified script of OpenSceneFlow without a GPU: python opensceneflow_launcher.py SCRIPT [arguments].

The current folder is the checkout. A module gets a replacement only if it cannot be imported, so in the harness's own
environment nothing is replaced. train.py and the runner of methods without training ask for CUDA and get the CPU.
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
import tempfile
import types
from typing import Any

import torch
from torch import Tensor, nn


def _not_available(*arguments: Any, **settings: Any) -> None:
    raise RuntimeError("this compiled extension is not available in the tests")


def _chamfer(pc0: Tensor, pc1: Tensor, distance0: Tensor, distance1: Tensor, index0: Tensor, index1: Tensor) -> None:
    """Write the squared distance from each point to the nearest one of the other cloud, and its index."""
    for start, target, distance, index in ((pc0, pc1, distance0, index0), (pc1, pc0, distance1, index1)):
        for rows in torch.arange(len(start)).split(1024):
            nearest = torch.cdist(start[rows], target).min(dim=1)
            distance[rows], index[rows] = nearest.values.square(), nearest.indices.to(index.dtype)


def _chamfer_gradient(
    pc0: Tensor, pc1: Tensor, index0: Tensor, index1: Tensor, out0: Tensor, out1: Tensor, grad0: Tensor, grad1: Tensor
) -> None:
    """Write the gradient of `_chamfer` into the last two arguments."""
    for start, target, index, out, own, other in (
        (pc0, pc1, index0.long(), out0, grad0, grad1),
        (pc1, pc0, index1.long(), out1, grad1, grad0),
    ):
        pull = 2 * out[:, None] * (start - target[index])
        own += pull
        other.index_add_(0, index, -pull)


REPLACEMENTS: dict[str, dict[str, Any]] = {  # module -> what the harness imports from it
    "torchvision": {
        "transforms": types.SimpleNamespace(Compose=lambda steps: lambda data: _chain(steps, data)),
    },
    "wandb": {"finish": lambda: None},
    "chamfer3D": {"forward": _chamfer, "backward": _chamfer_gradient},
    "mmcv": {
        f"{name}_{direction}": _not_available
        for name, direction in (
            ("dynamic_voxelize", "forward"),
            ("hard_voxelize", "forward"),
            ("dynamic_point_to_voxel", "forward"),
            ("dynamic_point_to_voxel", "backward"),
        )
    },
}


def _chain(steps: Any, data: Any) -> Any:
    for step in steps:
        data = step(data)
    return data


def add_replacements() -> None:
    """Replace every module that cannot be imported. Lightning comes first, because it looks for the real ones."""
    import lightning.pytorch  # noqa: F401
    import numpy as np

    if not hasattr(np, "NaN"):  # removed in NumPy 2
        np.NaN = np.nan
    for name, contents in REPLACEMENTS.items():
        try:
            importlib.import_module(name)
        except (ImportError, RuntimeError):  # RuntimeError: a torchvision of another torch
            sys.modules[name] = types.ModuleType(name)
            sys.modules[name].__dict__.update(contents)


class _TorchOnCPU:
    """`torch` for the runner: every device is the CPU."""

    def __getattr__(self, name: str) -> Any:
        return getattr(torch, name)

    def device(self, name: str) -> torch.device:
        return torch.device("cpu")


def run_runner_on_cpu() -> None:
    """Let `src.runner` run in this process, alone in a gloo group."""
    import torch.distributed as dist

    runner = importlib.import_module("src.runner")

    def join_group() -> tuple[int, int]:
        file = tempfile.NamedTemporaryFile(prefix="gloo", delete=False).name  # noqa: SIM115
        dist.init_process_group("gloo", init_method=f"file://{file}", rank=0, world_size=1)
        return 0, 1

    runner.torch = _TorchOnCPU()
    runner._setup_distributed_environment = join_group
    runner.launch_runner = lambda cfg, mode, *output_dir: runner._run_process(cfg, mode)


def train_one_step_on_cpu() -> None:
    """Let train.py make one step on the CPU, and write its losses as a CSV file into the current run's folder."""
    import lightning.pytorch as pl
    from lightning.pytorch.loggers import CSVLogger

    trainer = pl.Trainer

    def make(**settings: Any) -> Any:
        logger = CSVLogger(settings["logger"].save_dir)
        changes = {"accelerator": "cpu", "devices": 1, "sync_batchnorm": False, "log_every_n_steps": 1, "max_steps": 1}
        return trainer(**{**settings, **changes, "logger": logger, "limit_val_batches": 0})

    pl.Trainer = make


class TinyNetwork(nn.Module):
    """A network that the harness can train: flow is a linear function of position."""

    def __init__(self, **settings: Any) -> None:
        super().__init__()
        import dztimer

        self.timer = dztimer.Timing()
        self.flow = nn.Linear(3, 3)

    def forward(self, batch: dict[str, Any]) -> dict[str, list[Tensor]]:
        """Flow of every point, without ego motion: the simulated vehicle is slow."""
        clouds = {key: list(batch[key]) for key in ("pc0", "pc1")}
        valid = {key: [cloud.isfinite().all(dim=1).nonzero()[:, 0] for cloud in clouds[key]] for key in clouds}
        points = {key: [cloud[rows] for cloud, rows in zip(clouds[key], valid[key])] for key in clouds}
        return {
            "flow": [self.flow(cloud) for cloud in points["pc0"]],
            **{f"{key}_points_lst": points[key] for key in clouds},
            **{f"{key}_valid_point_idxes": valid[key] for key in clouds},
        }


if __name__ == "__main__":
    add_replacements()
    sys.dont_write_bytecode = True  # in the checkout
    sys.argv = sys.argv[1:]
    sys.path[0] = os.getcwd()  # as if the script had been started itself
    if not torch.cuda.is_available():
        if any(argument == "model.iter_only=true" for argument in sys.argv):
            run_runner_on_cpu()
        if sys.argv[0] == "train.py":
            train_one_step_on_cpu()
    runpy.run_path(sys.argv[0], run_name="__main__")
