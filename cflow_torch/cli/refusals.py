"""Explain in one line what Hydra rejects and what to do."""

from __future__ import annotations

import re

from hydra.errors import MissingConfigException, OverrideParseException

from cflow_torch.cli.choices import files, groups, near, own_settings, settings
from cflow_torch.config import CONFIGS
from cflow_torch.types import CFlowError

# Settings of the last version; those of the methods are in `config.REMOVED`.
_REMOVED = {"standing": "use remove_stopped", "residual_axes": "leave it out"}
_PLUGINS = "hydra-joblib-launcher hydra-submitit-launcher hydra-optuna-sweeper"


def explain(error: Exception, command: str) -> str:
    """The message for a call that Hydra or a command rejects."""
    if isinstance(error, CFlowError):
        return str(error)
    if isinstance(error, MissingConfigException) and error.options:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        if group.startswith("hydra/"):
            return f"there is no {group} {name!r}: joblib, submitit and optuna need pip install {_PLUGINS}"
        known = [option for option in error.options if not option.startswith("base_")]
        return f"{group}={name}{near(name, known)}: give one of {', '.join(known)}"
    if isinstance(error, OverrideParseException):
        return f"cannot read {error.override!r}: give NAME=VALUE, special characters in quotes: 'NAME=\"VALUE\"'"
    message = " ".join((f"{error}: {error.__cause__}" if error.__cause__ else str(error)).split())
    unknown = re.search(r"Key '.*?' (?:is )?not in .*full_key: (\S+) object_type=(\w+)", message)
    if unknown:
        return _unknown(unknown[1], unknown[2], command)
    message = message.partition(" full_key:")[0].replace("Error merging override ", "")
    return f"{message}; `cflow {command} --help` has examples"


def _unknown(key: str, kind: str, command: str) -> str:
    """The message for an unknown setting: it belongs to another method or picture, was removed, or is mistyped."""
    group, _, name = key.rpartition(".")
    method = {config.__name__: config for config in CONFIGS.values()}.get(kind)
    if group == "model" and method is not None and name != "pixel_size":
        try:
            method().replace(**{name: None})
        except CFlowError as error:
            if not str(error).startswith("unknown"):
                return str(error)
    owners = [f"picture={file.stem}" for file in files("picture") if key in own_settings(file)]
    if command == "plot" and owners:
        return f"setting {key!r} belongs to {' or '.join(owners)}: give that as well, or leave the setting out"
    if name in _REMOVED:
        return f"setting {name} was removed: {_REMOVED[name]}"
    known = [*groups(command), *settings(command)]
    if key in known:  # for example of another data set
        return f"the chosen configuration has no setting {key!r}: give +{key}=VALUE to add it, or leave it out"
    return f"unknown setting {key!r}{near(key, known)}: `cflow {command} --cfg job` prints all settings"
