"""The checkpoint without weights: what lets the harness's Lightning path run a method that has nothing to load."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict, Union

import torch

from cflow_torch.data.atomic import atomic_file
from cflow_torch.types import CFlowError


def null_checkpoint(name: str = "cflow") -> Dict[str, Any]:
    """What the file holds: plain containers only, so that `torch.load(weights_only=True)` takes it.

    Args:
        name: label of the output folder and of printed tables.

    Convention:
        `model.target` is left out: the harness replaces the settings of the command line by those of a checkpoint,
        where it has any. So overrides and sweeps keep their effect.
    """
    return {
        "epoch": 0,
        "global_step": 0,
        "pytorch-lightning_version": "2.0.1",
        "state_dict": {},
        "hyper_parameters": {"cfg": {"model": {"name": name}, "output": name, "num_frames": 2}, "eval": True},
    }


def write_null_checkpoint(file: Union[str, Path], overwrite: bool = False) -> Path:
    """Write the checkpoint without weights; its stem becomes the name.

    Args:
        file: for example `cflow.ckpt`. The harness's save.py names its results by the stem.
        overwrite: replace a file that is there.

    Returns:
        The file.

    Raises:
        CFlowError: the file is there already (it might hold weights), or cannot be written.
    """
    file = Path(file)
    if file.exists() and not overwrite:
        raise CFlowError(f"{file} is there already: give another name, or overwrite (--overwrite)")
    try:
        with atomic_file(file) as new:
            torch.save(null_checkpoint(file.stem), new)
    except OSError as error:
        raise CFlowError(f"{file} cannot be written ({error}): give a file in a folder that is there") from error
    return file
