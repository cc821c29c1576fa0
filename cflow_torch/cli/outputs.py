"""The output folder of a run, and its config.yaml: settings and versions."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from cflow_torch import __version__
from cflow_torch.cli.commands import Command, Submit
from cflow_torch.cli.failures import is_sweep
from cflow_torch.cli.info import processor
from cflow_torch.data.atomic import ensure_writable, write_text
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.changes import check_same_run, nearest_preset
from cflow_torch.types import CFlowError


def versions() -> dict[str, str]:
    return {
        "cflow_torch": __version__,
        "torch": str(torch.__version__),
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def machine() -> dict[str, Any]:
    """Describe the machine, on which times depend: "platform", "cpu", "cores", "threads" (of torch)."""
    return {
        "platform": platform.platform(),
        "cpu": processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
    }


def chosen_preset(cfg: Command) -> str:
    """Return the preset of a run; the nearest one if its settings come from the config.yaml of an earlier run."""
    return str(HydraConfig.get().runtime.choices.get("model") or nearest_preset(asdict(cfg.model)))


def output_folder(cfg: Command) -> Path:
    """The output folder of a run: `cfg.output`, or for a job of a sweep the folder below it that Hydra names.

    The jobs of a sweep over shards are parts of one run, so they share `cfg.output`.
    """
    folder = as_path(cfg.output)
    if not is_sweep() or any(override.startswith("shard.index=") for override in HydraConfig.get().overrides.task):
        return folder
    return folder / HydraConfig.get().sweep.subdir


def local_folder(cfg: Command) -> Path:
    """Return the output folder of a command that writes to this machine only. A remote one raises a `CFlowError`."""
    output = output_folder(cfg)
    if is_remote(output):
        raise CFlowError(f"output={output}: give a folder of this machine, and copy the files from there")
    return output


def settings_record(cfg: Command) -> dict[str, Any]:
    """Return the settings of a run for YAML and JSON; the command reads them again."""
    return {name: value for name, value in asdict(cfg).items() if name not in ("row", "experiment")}


def write_config(cfg: Command, folder: Path) -> None:
    """Write the settings and versions to `folder/config.yaml`."""
    write_text(folder / "config.yaml", OmegaConf.to_yaml(_config(cfg)))


def claim_output(cfg: Submit, folder: Path, ignored: Sequence[str]) -> None:
    """Reject a folder whose config.yaml has other settings or versions, unless `cfg.overwrite`; write config.yaml.

    The settings `ignored` may differ, because files do not depend on them.
    """
    file = ensure_writable(folder) / "config.yaml"
    if file.exists() and not cfg.overwrite:
        before = OmegaConf.to_container(OmegaConf.create(file.read_text(encoding="utf-8")))
        now = OmegaConf.to_container(_config(cfg))
        check_same_run(folder, before, now, ("output", "overwrite", *ignored))
    write_config(cfg, folder)


def _config(cfg: Command) -> Any:
    return OmegaConf.create({**settings_record(cfg), "versions": versions()})
