"""Register the presets with Hydra, check settings, and explain in one line why a call is rejected.

This module does not import torch.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Mapping

from hydra.core.config_store import ConfigStore
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import OmegaConf

from cflow_torch.cli.choices import defaults, files, groups, near, own_settings, settings
from cflow_torch.config import CONFIGS, PRESETS, REMOVED_PRESETS, Config, config_from, make_config, removed_preset
from cflow_torch.errors import CFlowError
from cflow_torch.setting import bounds, checked

# Settings of commands that the last version had; for those of the methods, see `config.REMOVED`.
_REMOVED = {"standing": "use remove_stopped", "residual_axes": "leave it out"}
# Values that are allowed besides the default. A setting that is not listed must have the type of its default.
_FROM_0, _FROM_1 = bounds(int, low=0), bounds(int, low=1)
_ABOVE_0 = bounds(float, above=0, high=1e12)
_ALLOWED = {
    **dict.fromkeys(("first", "seed", "first_seed", "pair", "index"), _FROM_0),
    **dict.fromkeys(("step", "count", "num_sweeps", "num_drives", "pairs", "repeats", "batches", "width"), _FROM_1),
    **dict.fromkeys(("workers", "batch"), bounds(int, low=1, high=100_000)),  # more is a typing error
    **dict.fromkeys(("voxel_size", "voxel", "max_flow", "frames_per_second", "timeout", "memory"), _ABOVE_0),
    **dict.fromkeys(("num_cpus", "num_gpus"), bounds(float, low=0, high=1e6)),
    "pace": {**_ABOVE_0, "optional": True},
    "cluster": bounds(int),
    "view.format": bounds(str, choices=("html", "rerun")),
    "animation.format": bounds(str, choices=("gif", "mp4")),
    "truth": bounds(object, choices=(True, False, "auto")),
    "tracks": bounds(object, choices=(True, False, "mot", "kitti")),
}
_TYPES = {kind: bounds(kind) for kind in (bool, int, float)}
_PLUGINS = "hydra-joblib-launcher hydra-submitit-launcher hydra-optuna-sweeper"


def _register(name: str, config: Config) -> None:
    node = OmegaConf.structured(config)
    OmegaConf.set_readonly(node, None)  # the fields of a frozen dataclass can be overridden
    ConfigStore.instance().store(name, node, "model")


for _method, _kind in CONFIGS.items():
    _register(f"base_{_method}", _kind())
for _preset in PRESETS:
    _register(_preset, make_config(_preset))


class UnfinishedJob(RuntimeError):
    """Something is missing, and a message says what. The other jobs of a sweep still run."""


def check_settings(cfg: Any, command: str, choices: Mapping[str, Any]) -> None:
    """Check settings and the path of the data, before torch is imported. `choices` maps groups to options."""
    config_from(OmegaConf.to_container(cfg.model, resolve=True))  # type: ignore[arg-type]
    for name, file, default in defaults(command, choices):
        value = OmegaConf.select(cfg, name, default=default)
        own = name.rpartition(".")[2]
        limits = _ALLOWED.get(f"{file}.{own}") or _ALLOWED.get(own) or _TYPES.get(type(default))
        if limits is not None and value != default:
            for one in value if isinstance(default, list) and OmegaConf.is_list(value) else [value]:
                checked(name, one, limits)
    for name in ("first", "step"):  # your own reader has them, too; we know no other setting of it
        checked(f"data.{name}", cfg.data.get(name, 1), _ALLOWED[name])
    if "_target_" in cfg.data:
        return
    if OmegaConf.is_missing(cfg.data, "root"):
        raise CFlowError("the data is missing: give data.root=PATH, or only the path")
    root = cfg.data.get("root")
    if isinstance(root, str) and "://" not in root and not Path(root).exists():
        raise CFlowError(f"{root}: there is no such file or folder; settings are NAME=VALUE")


def explain(error: Exception, command: str) -> str:
    """Return the message for a call that Hydra or a command rejects."""
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
    """Return the message for a setting (dotted) that is of another method or picture, was removed, or is mistyped."""
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
