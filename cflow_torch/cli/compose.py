"""Hydra composes the settings of a command from its defaults, the presets, YAML files and the words of a call."""

from __future__ import annotations

import os
import sys
import traceback
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Iterator

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cflow_torch.cli.commands import ENGINES, NOT_GIVEN, PICTURES, WITH_SETTINGS, Check, Command, Plot, own_fields
from cflow_torch.cli.failures import UnfinishedJob, exit_if_refused, exit_wrong
from cflow_torch.cli.words import check_exists
from cflow_torch.config import PRESETS
from cflow_torch.errors import CFlowError
from cflow_torch.fleet.progress import show_warnings_as_lines
from cflow_torch.setting import AUTO, Settings

_PARSER = OverridesParser.create()
_PLUGINS = "hydra-joblib-launcher hydra-submitit-launcher hydra-optuna-sweeper"


def _register() -> None:
    """Register the settings of commands and of their groups, and the presets, where Hydra looks for configurations.

    We register plain dictionaries: `Settings.of` checks the values.
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
    values: dict[str, Any] = {}
    for f in own_fields(kind):
        is_nested = issubclass(f.metadata["kind"], Settings)
        values[f.name] = (
            asdict(f.default) if is_nested else list(f.default) if isinstance(f.default, tuple) else f.default
        )
    return values


_register()


def run_with_hydra(name: str, overrides: list[str], options: list[str]) -> None:
    """Let Hydra compose the settings of a command and run it with them, or with those of each job of a sweep."""

    @hydra.main(version_base="1.3", config_path="pkg://cflow_torch.configs", config_name=name)
    def job(composed: Any) -> Any:
        with errors_told(name):
            values: Any = OmegaConf.to_container(composed, resolve=True)
            for name_of_record in ("command", "versions"):  # in the config.yaml of an earlier run
                values.pop(name_of_record, None)
            settings = WITH_SETTINGS[name].of(values)  # checks the values, before torch is imported
            show_warnings_as_lines()
            settings = replace(settings, data=_complete(settings))
            from cflow_torch.windows.memory import keep_freed_memory  # imports torch, which takes seconds

            keep_freed_memory()
            return import_module(f"cflow_torch.cli.{name}").task(settings)

    with errors_told(name), TemporaryDirectory() as folder:
        # A job's folder is named after the swept settings, and after experiment and data.label if they are given.
        parsed = _PARSER.parse_overrides(overrides)
        fixed = {str(one.key_or_group) for one in parsed if not one.is_sweep_override()}
        unnamed = {"output", "overwrite", *fixed} - {"experiment", "data.label"}
        names = f"hydra.job.config.override_dirname.exclude_keys=[{','.join(sorted(unnamed))}]"
        # Hydra, its sweepers and launchers write their own files to OUTPUT. They know no object stores.
        is_remote = any(one.key_or_group == "output" and "://" in str(one.value()) for one in parsed)
        dirs = [f'hydra.sweep.dir="{Path(folder).as_posix()}"'] if is_remote else []
        os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises errors instead of printing them
        sys.argv = [f"cflow {name}", *dirs, *overrides, names, *options]
        job()


def _complete(settings: Command) -> dict[str, Any]:
    """Check the paths of the data, and complete its settings.

    data=auto is replaced by the format of the path, which is printed; `cflow check` does this for each of its paths.
    """
    data = settings.data
    if "_target_" in data:  # your own reader, whose module is next to its configuration
        for source in HydraConfig.get().runtime.config_sources:
            if source.schema == "file" and source.path not in sys.path:
                sys.path.append(source.path)
        return {"label": str(HydraConfig.get().runtime.choices.get("data")), "first": 0, "step": 1, **data}
    root = data.get("root")
    if root in (NOT_GIVEN, []) or (root is None and "root" in data and data["name"] != AUTO):
        raise CFlowError("the data is missing: give data.root=PATH, or only the path")
    for path in root if isinstance(root, list) else [root]:
        if isinstance(path, str):
            check_exists(path)
    from cflow_torch.cli.logs import complete_data  # imports torch

    return data if isinstance(settings, Check) else complete_data(data)


@contextmanager
def errors_told(command: str) -> Iterator[None]:
    """Exit with status 2 if the call was wrong. A bug raises `UnfinishedJob`: a sweep goes on."""
    try:
        yield
    except UnfinishedJob:
        raise
    except (CFlowError, OmegaConfBaseException, HydraException) as error:
        exit_wrong(explain(error, command))
    except Exception as error:
        exit_if_refused(error)
        traceback.print_exc()
        message = "this is a bug of cflow: please report it with the lines above and the output of `cflow info`"
        raise UnfinishedJob(message) from None


def explain(error: Exception, command: str) -> str:
    """Return the message for a call that Hydra or a command rejects."""
    if isinstance(error, CFlowError):
        return str(error)
    if isinstance(error, MissingConfigException) and str(error.missing_cfg_file).startswith("hydra/"):
        return f"there is no {error.missing_cfg_file}: joblib, submitit and optuna need pip install {_PLUGINS}"
    if isinstance(error, OverrideParseException):
        return f"cannot read {error.override!r}: give NAME=VALUE, special characters in quotes: 'NAME=\"VALUE\"'"
    message = " ".join(str(error).split())
    if message.startswith("Ambiguous value"):
        word = message.split("'")[1]
        return f"{word}: for a list, give [...] around the values; for a run with each of them (a sweep), add -m"
    return f"{message}; `cflow {command} --help` has examples"
