"""The checkpoint without weights. It lets OpenSceneFlow's Lightning scripts run a method that has nothing to load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from cflow_torch.data.atomic import atomic_file
from cflow_torch.types import CFlowError


def write_null_checkpoint(file: str | Path, overwrite: bool = False) -> Path:
    """Write the checkpoint without weights and return its path.

    Args:
        file: for example `cflow.ckpt`. Its stem labels the output folder and the printed tables, and save.py stores
            its results under this name.
        overwrite: replace an existing file.

    Convention:
        It contains plain containers only, so that `torch.load(weights_only=True)` reads it. It has no `model.target`,
        because the harness prefers the settings of a checkpoint to those of the command line, which must win.

    Raises:
        CFlowError: the file exists already (it might contain weights).
    """
    file = Path(file)
    if file.exists() and not overwrite:
        raise CFlowError(f"{file} exists already: give another name, or overwrite it (--overwrite)")
    cfg = {"model": {"name": file.stem}, "output": file.stem, "num_frames": 2}
    contents: dict[str, Any] = {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": "2.0.1",
        "state_dict": {},
        "hyper_parameters": {"cfg": cfg, "eval": True},
    }
    with atomic_file(file) as new:
        torch.save(contents, new)
    return file
