"""The checkpoint without weights: what lets the harness's Lightning path run a method that has nothing to load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from cflow_torch.data.atomic import atomic_file
from cflow_torch.types import CFlowError


def write_null_checkpoint(file: str | Path, overwrite: bool = False) -> Path:
    """Write the checkpoint without weights; its stem becomes the label of the output folder and of printed tables.

    Args:
        file: for example `cflow.ckpt`. The harness's save.py names its results by the stem.
        overwrite: replace a file that is there.

    Returns:
        The file.

    Convention:
        Plain containers only, so that `torch.load(weights_only=True)` takes it. `model.target` is left out, because the
        harness lets a checkpoint's settings win over those of the command line: overrides and sweeps have an effect.

    Raises:
        CFlowError: the file is there already (it might hold weights).
        OSError: it cannot be written.
    """
    file = Path(file)
    if file.exists() and not overwrite:
        raise CFlowError(f"{file} is there already: give another name, or overwrite (--overwrite)")
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
