"""Hydra composes the settings of a command from its defaults, the presets, YAML files and the words of a call."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict, fields, replace
from typing import Any, Callable

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf

from cflow_torch.cli.commands import ENGINES, PICTURES, WITH_SETTINGS, Check, Command, Plot
from cflow_torch.cli.words import NOT_GIVEN, Call, check_exists, make_settings, text_names
from cflow_torch.config import PRESETS
from cflow_torch.errors import CFlowError
from cflow_torch.setting import Settings

_PARSER = OverridesParser.create()
_PLUGINS = "hydra-joblib-launcher hydra-submitit-launcher hydra-optuna-sweeper"


def _register() -> None:
    """Register the settings of commands and of their groups, and the presets, where Hydra looks for configurations.

    We register plain dictionaries: `settings_of` checks the values.
    """
    store = ConfigStore.instance().store
    for name, command in WITH_SETTINGS.items():
        groups = [{group: choice} for group, choice in command.groups().items()]
        store(name, {"defaults": ["hydra", "_self_", *groups], **_defaults(command)})
    for name, config in PRESETS.items():
        store(name, config.as_dict(), "model")
    for name, engine in ENGINES.items():
        store(name, _defaults(engine), "engine")
    for name, picture in PICTURES.items():
        store(name, _picture_node(name, picture), "picture", package="_global_")


def _picture_node(name: str, picture: type[Plot]) -> dict[str, Any]:
    of_all = _defaults(Plot)
    own = {key: value for key, value in _defaults(picture).items() if key not in of_all}
    model = [{"override /model": picture.PRESET}] if picture.PRESET else []
    changes = {"model": {"pixel_sizes": list(picture.PIXEL_SIZES)}} if picture.PIXEL_SIZES else {}
    return {"defaults": [*model, "_self_"], "picture": name, **own, **changes}


def _defaults(kind: type[Settings]) -> dict[str, Any]:
    """Return the defaults of the settings of a class, in types that OmegaConf has."""
    own = [f.name for f in fields(kind) if "kind" in f.metadata]  # type: ignore[arg-type]
    values: dict[str, Any] = asdict(kind())  # type: ignore[call-overload]
    return {name: list(values[name]) if isinstance(values[name], tuple) else values[name] for name in own}


_register()


def run_with_hydra(name: str, call: Call, job: Callable[[Any], Any]) -> None:
    """Let Hydra compose the settings of a command and call `job` with them, or with those of each job of a sweep."""
    overrides = hydra_overrides(WITH_SETTINGS[name], call)
    # A job's folder is named after the swept settings, and after experiment and data.label if they are given.
    parsed = _PARSER.parse_overrides(overrides)
    fixed = {str(one.key_or_group) for one in parsed if not one.is_sweep_override()}
    unnamed = {"output", "overwrite", *fixed} - {"experiment", "data.label"}
    names = f"hydra.job.config.override_dirname.exclude_keys=[{','.join(sorted(unnamed))}]"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
    sys.argv = [f"cflow {name}", *overrides, names, *call.options]
    hydra.main(version_base="1.3", config_path="pkg://cflow_torch.configs", config_name=name)(job)()


def hydra_overrides(command: type[Command], call: Call) -> list[str]:
    """Return the settings of a call as Hydra reads them: text in quotes where needed, paths as data.root."""
    texts = text_names(command)
    overrides = []
    for word in call.settings:
        key, _, value = word.partition("=")
        overrides.append(f"{key}={_as_text(value)}" if key.lstrip("+") in texts else word)
    paths = [_quoted(path) for path in call.paths]
    if paths:
        overrides.append(f"data.root={paths[0] if len(paths) == 1 else '[' + ','.join(paths) + ']'}")
    return overrides


def _as_text(value: str) -> str:
    """Quote text that Hydra would read as another type or reject: the name 1e5 is not a number."""
    try:
        read = _PARSER.parse_override(f"name={value}").value()
    except HydraException:  # such as Ausgänge
        return ",".join(_quoted(one) for one in value.split(","))
    if isinstance(read, ChoiceSweep) and read.simple_form:  # of a sweep: a,b
        return ",".join(_as_text(one) for one in value.split(","))
    return _quoted(value) if isinstance(read, (bool, int, float)) else value


def _quoted(value: str) -> str:
    return '"' + value.replace('"', r"\"") + '"'


def find_own_modules() -> None:
    """Let Python find the module of your own reader, which is next to its configuration."""
    for source in HydraConfig.get().runtime.config_sources:
        if source.schema == "file" and source.path not in sys.path:
            sys.path.append(source.path)


def settings_of(name: str, composed: Any) -> Command:
    """Make the settings of a command from those that Hydra has composed. Values are checked before torch is imported.

    data=auto is replaced by the format of the path, which is printed; `cflow check` does this for each of its paths.
    """
    values: dict[str, Any] = OmegaConf.to_container(composed, resolve=True)  # type: ignore[assignment]
    values.pop("versions", None)  # of the config.yaml of an earlier run
    settings: Any = make_settings(name, values)
    _check_paths(settings.data)
    from cflow_torch.cli.logs import complete_data  # imports torch, which takes seconds

    if "_target_" in settings.data:  # your own reader
        choice = str(HydraConfig.get().runtime.choices.get("data"))
        return replace(settings, data={"label": choice, "first": 0, "step": 1, **settings.data})  # type: ignore[no-any-return]
    is_completed = isinstance(settings, Check)
    return settings if is_completed else replace(settings, data=complete_data(settings.data))  # type: ignore[no-any-return]


def _check_paths(data: dict[str, Any]) -> None:
    root = data.get("root")
    if root == NOT_GIVEN:
        raise CFlowError("the data is missing: give data.root=PATH, or only the path")
    for path in root if isinstance(root, list) else [root]:
        if isinstance(path, str) and "_target_" not in data:
            check_exists(path)


def explain(error: Exception, command: str) -> str:
    """Return the message for a call that Hydra or a command rejects."""
    if isinstance(error, CFlowError):
        return str(error)
    if isinstance(error, MissingConfigException) and str(error.missing_cfg_file).startswith("hydra/"):
        return f"there is no {error.missing_cfg_file}: joblib, submitit and optuna need pip install {_PLUGINS}"
    if isinstance(error, OverrideParseException):
        return f"cannot read {error.override!r}: give NAME=VALUE, special characters in quotes: 'NAME=\"VALUE\"'"
    message = " ".join(str(error).split())
    return f"{message}; `cflow {command} --help` has examples"
