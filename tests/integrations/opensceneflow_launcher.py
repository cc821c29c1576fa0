"""Run an unmodified script of OpenSceneFlow without a GPU: python opensceneflow_launcher.py SCRIPT [arguments].

The current folder is the checkout. Compiled extensions that cannot be imported are replaced by those of
scripts/benchmarks/opensceneflow_cpu.py, so in the harness's own environment nothing is replaced. train.py and the
runner of methods without training ask for CUDA and get the CPU.
"""

from __future__ import annotations

import importlib
import os
import runpy
import sys
import tempfile
from typing import Any

import torch
from opensceneflow_cpu import add_replacements
from torch import Tensor, nn


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
    sys.dont_write_bytecode = sys.pycache_prefix is None  # nothing is written into the checkout
    sys.argv = sys.argv[1:]
    sys.path[0] = os.getcwd()  # as if the script had been started itself
    if not torch.cuda.is_available():
        if any(argument == "model.iter_only=true" for argument in sys.argv):
            run_runner_on_cpu()
        if sys.argv[0] == "train.py":
            train_one_step_on_cpu()
    runpy.run_path(sys.argv[0], run_name="__main__")
