"""The output folder of a run, and its config.yaml: settings and versions."""

from __future__ import annotations

import os
import platform
import shutil
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Sequence

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from cflow_torch.cli.choices import free_names
from cflow_torch.cli.commands import WITH_SETTINGS, Command, Submit
from cflow_torch.cli.failures import is_sweep
from cflow_torch.cli.info import processor
from cflow_torch.data.atomic import ensure_writable, write_text
from cflow_torch.data.json_file import json_ready
from cflow_torch.data.paths import as_path, is_remote
from cflow_torch.fleet.changes import check_same_run, nearest_preset
from cflow_torch.fleet.manifest import versions
from cflow_torch.types import CFlowError

_CONFIG = "config.yaml"
_OF_CALL = ("row", "experiment", "shard", "dry_run", "overwrite")
_DEFAULTS = {"defaults": ["hydra", "_self_"]}  # so that our settings of Hydra also hold for `--config-name config`


def machine() -> dict[str, Any]:
    """Describe the machine: "platform", "cpu", "cores", "threads" (of torch), "torch" (its build), "python"."""
    return {
        "torch": str(torch.__version__),
        "python": platform.python_version(),
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
    """Return the settings of a run for YAML and JSON, without those of a single call; the command reads them again."""
    return {name: value for name, value in asdict(cfg).items() if name not in _OF_CALL}


def write_config(cfg: Command, folder: Path) -> None:
    """Write the settings and versions to `folder/config.yaml`, in place of those of an earlier run only."""
    read_config(cfg, folder)
    config = {**_DEFAULTS, "command": _command(cfg), **settings_record(cfg), "versions": versions()}
    write_text(folder / _CONFIG, OmegaConf.to_yaml(OmegaConf.create(config)))


def _command(cfg: Command) -> str:
    return next(name for name, kind in WITH_SETTINGS.items() if isinstance(cfg, kind))


def read_config(cfg: Command, folder: Path) -> dict[str, Any]:
    """Read the settings and versions of an earlier run of this command; {} = there are none.

    A file of another command, or of others, is a `CFlowError`.
    """
    file = folder / _CONFIG
    if not file.exists():
        return {}
    content = file.read_bytes()
    with suppress(Exception):  # whatever a file of others holds
        config: Any = OmegaConf.to_container(OmegaConf.create(content.decode("utf-8")))
        if "cflow_torch" in config["versions"]:
            config.pop("defaults", None)
            if config.pop("command", _command(cfg)) == _command(cfg):
                return config  # type: ignore[no-any-return]
    raise CFlowError(f"{file} is not a record of `cflow {_command(cfg)}`, and we do not replace it: give output=FOLDER")


def made_by(cfg: Command, **more: Any) -> dict[str, Any]:
    """Return what results follow from, in types that JSON has: the settings, the versions and what else is given."""
    return json_ready({**settings_record(cfg), "versions": versions(), **more})  # type: ignore[no-any-return]


def check_made_by(cfg: Command, folder: Path, before: Any, now: Any) -> None:
    """Raise a `CFlowError` if the results in a folder follow from something else than `made_by` says now.

    Settings that are `free` may differ.
    """
    check_same_run(folder, json_ready(before), now, free_names(type(cfg)))


def claim_output(cfg: Submit, folder: Path, results: Sequence[Path]) -> None:
    """Reject a folder with results of other settings, or with `results` that have no config.yaml; write config.yaml.

    With `cfg.overwrite`, we remove older results, but not what is not ours.
    """
    before = read_config(cfg, ensure_writable(folder))
    for path in results:
        if path.exists() and not before:
            raise CFlowError(f"{path} exists and is not a result of `cflow submit`: give output=FOLDER")
    if cfg.overwrite:
        for path in results:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    elif before:
        check_made_by(cfg, folder, before, made_by(cfg))
    write_config(cfg, folder)
