"""Explain in one line what a command or Hydra rejects and what to do. This module does not import torch."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import OmegaConf

from cflow_torch.cli.choices import files, groups, near, own_settings, settings
from cflow_torch.config import CONFIGS, REMOVED_PRESETS, config_from, removed_preset
from cflow_torch.errors import CFlowError

# Settings of the last version; those of the methods are in `config.REMOVED`.
_REMOVED = {"standing": "use remove_stopped", "residual_axes": "leave it out"}
_PLUGINS = "hydra-joblib-launcher hydra-submitit-launcher hydra-optuna-sweeper"


class UnfinishedJob(RuntimeError):
    """Something is missing, and a message says what. The other jobs of a sweep still run."""


def check_settings(cfg: Any) -> None:
    """Check the settings of a method and the path of the data, before torch is imported."""
    config_from(OmegaConf.to_container(cfg.model, resolve=True))  # type: ignore[arg-type]
    if "_target_" in cfg.data:
        return
    if OmegaConf.is_missing(cfg.data, "root"):
        raise CFlowError("the data is missing: give data.root=PATH, or only the path")
    root = cfg.data.get("root")
    if isinstance(root, str) and "://" not in root and not Path(root).exists():
        raise CFlowError(f"{root}: there is no such file or folder; settings are NAME=VALUE")


def explain(error: Exception, command: str) -> str:
    """The message for a call that Hydra or a command rejects."""
    if isinstance(error, CFlowError):
        return str(error)
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        if group.startswith("hydra/"):
            return f"there is no {group} {name!r}: joblib, submitit and optuna need pip install {_PLUGINS}"
        if group == "model" and name in REMOVED_PRESETS:
            return removed_preset(name)
        names = sorted(option for option in error.options if not option.startswith("base_"))
        return f"{group}={name}{near(name, names)}: give one of {', '.join(names)}"
    if isinstance(error, OverrideParseException):
        return f"cannot read {error.override!r}: give NAME=VALUE, special characters in quotes: 'NAME=\"VALUE\"'"
    message = " ".join((f"{error}: {error.__cause__}" if error.__cause__ else str(error)).split())
    unknown = re.search(r"Key '.*?' (?:is )?not in .*full_key: (\S+) object_type=(\w+)", message)
    if unknown:
        methods = {config.__name__: method for method, config in CONFIGS.items()}
        return _unknown_setting(unknown[1], methods.get(unknown[2]), command)
    message = message.partition(" full_key:")[0].replace("Error merging override ", "")
    return f"{message}; `cflow {command} --help` has examples"


def _unknown_setting(key: str, method: str | None, command: str) -> str:
    """The message for a setting (in dotted form) that is of another method or picture, was removed, or is mistyped."""
    group, _, name = key.rpartition(".")
    if group == "model" and method is not None and name != "pixel_size":
        try:
            CONFIGS[method]().replace(**{name: None})
        except CFlowError as error:
            if not str(error).startswith("unknown"):
                return str(error)
    pictures = [f"picture={file.stem}" for file in files("picture") if key in own_settings(file)]
    if command == "plot" and pictures:
        return f"setting {key!r} belongs to {' or '.join(pictures)}: give that as well, or leave the setting out"
    if name in _REMOVED:
        return f"setting {name} was removed: {_REMOVED[name]}"
    known = [*groups(command), *settings(command)]
    if key in known:  # for example of another data set
        return f"the chosen configuration has no setting {key!r}: give +{key}=VALUE to add it, or leave it out"
    return f"unknown setting {key!r}{near(key, known)}: `cflow {command} --cfg job` prints all settings"
