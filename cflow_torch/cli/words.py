"""The words after `cflow COMMAND`: settings, paths and options, and a check of their names.

We do not import Hydra here, so that a mistyped name is told at once.
"""

from __future__ import annotations

import glob
import math
import os
from contextlib import suppress
from dataclasses import fields
from typing import Any, NamedTuple

from cflow_torch.cli.choices import choices, near, setting_names
from cflow_torch.cli.commands import (
    DATA_SETTINGS,
    ENGINES,
    PICTURES,
    WITH_SETTINGS,
    Command,
)
from cflow_torch.config import PRESETS, config_from
from cflow_torch.errors import CFlowError
from cflow_torch.setting import Settings, checked

# Options of Hydra that the next word belongs to; the first of them name configurations of your own.
_OWN_CONFIGS = ("-cd", "--config-dir", "-cn", "--config-name", "-cp", "--config-path")
_WITH_VALUE = (*_OWN_CONFIGS, "-c", "--cfg", "-p", "--package", "-i", "--info")
_FLAGS = ("-m", "--multirun", "-r", "--run", "--resolve", "--hydra-help", "--version", "-sc", "--shell-completion")
_LITERALS = {"null": None, "true": True, "false": False, "inf": math.inf, "nan": math.nan}
NOT_GIVEN = "???"  # a setting without a value
_NOT_PLAIN = "'\"[{(*$"  # characters by which a value is a list, a text, a function or a reference of Hydra's


class Call(NamedTuple):
    """The words of a call. A word without "=" is a path."""

    settings: list[str]
    paths: list[str]
    options: list[str]


def read_call(words: list[str], command: str) -> Call:
    """Read the words after a command. An option, a path or a name that does not exist is a `CFlowError`.

    With `--config-dir`, your own configurations may have other choices and settings of groups; Hydra knows them.
    """
    call = split(words)
    given = {option.partition("=")[0] for option in call.options if option.startswith("-")}
    for option in given - {*_FLAGS, *_WITH_VALUE}:
        raise CFlowError(f"unknown option {option!r}: give settings as NAME=VALUE; `cflow {command} --help` lists them")
    for path in call.paths if not given & {"-c", "--cfg"} else ():  # these only print the settings
        check_exists(path)
    _check_settings(call.settings, command, bool(given & set(_OWN_CONFIGS)))
    return call


def split(words: list[str]) -> Call:
    """Split the words of a call. Hydra accepts no option, such as `-m`, between two settings."""
    call = Call([], [], [])
    for before, word in zip(["", *words], words):
        if word.startswith("-") or before in _WITH_VALUE:
            call.options.append(word)
        elif ("=" in word or word[0:1] in ("+", "~")) and not _is_path(word):
            call.settings.append(word)
        else:
            call.paths.extend(sorted(glob.glob(word)) or [word])
    return call


def _is_path(word: str) -> bool:
    """Test whether a word with "=" is a path, such as date=2024-01-05/drive, and not a setting."""
    return word.startswith(("/", "./", "../", "~/")) or os.path.exists(word)


def _check_settings(settings: list[str], command: str, has_own: bool) -> None:
    """Reject names that do not exist and plain values that are not allowed."""
    kind = WITH_SETTINGS[command]
    chosen = dict.fromkeys(kind.groups(), []) if has_own else _chosen(settings, kind)
    known = setting_names(kind)
    texts = text_names(kind)
    values: dict[str, Any] = {}
    for word in settings:
        key, _, value = word.partition("=")
        if key in chosen or _is_for_hydra(key) or any(name.startswith(f"{key}.") for name in known):
            continue
        if has_own and key.partition(".")[0] in chosen:
            continue
        if key not in known:
            hint = near(key, [*chosen, *known])
            raise CFlowError(f"unknown setting {key!r}{hint}: `cflow {command} --cfg job` prints all settings")
        owners = known[key]
        group = owners[0].partition("=")[0] if owners else ""
        if chosen.get(group) and not {f"{group}={choice}" for choice in chosen[group]} & set(owners):
            raise CFlowError(f"setting {key!r} belongs to {' or '.join(owners)}: give that as well, or leave it out")
        with suppress(ValueError):
            plain = plain_value(value)
            values[key] = value if key in texts and plain is not None else plain
    single = {group: names[0] for group, names in chosen.items() if len(names) == 1}
    make_settings(command, _nested(values, kind, single))


def text_names(kind: type[Command]) -> set[str]:
    """Return the names of settings whose values are text, even if they look like numbers."""
    return {f.name for f in fields(kind) if f.metadata.get("kind") is str} | {"data.root", "data.cache"}


def plain_value(text: str) -> Any:
    """Return the value that Hydra reads from a text: null, a truth, a number, text, or a list of them.

    A ValueError is raised for a text that is more than this, such as the values of a sweep.
    """
    if text[:1] == "[" and text[-1:] == "]":
        return [plain_value(one.strip()) for one in text[1:-1].split(",")]
    if not text or set(text) & set(_NOT_PLAIN) or "," in text:
        raise ValueError(text)
    if text.lower() in _LITERALS:
        return _LITERALS[text.lower()]
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def _nested(values: dict[str, Any], kind: type[Command], chosen: dict[str, str]) -> dict[str, Any]:
    """Nest the values of dotted names, and fill in the groups of which one choice is known. Others are left out."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        group, _, own = key.rpartition(".")
        level = nested.setdefault(group, {}) if group else nested
        level[own] = value
    model = nested.pop("model", {})
    if "model" in chosen:
        nested["model"] = {**PRESETS[chosen["model"]].as_dict(), **model}
    engine = nested.pop("engine", {})
    if "engine" in chosen:
        nested["engine"] = {"name": chosen["engine"], **engine}
    if "picture" in chosen:
        return {**nested, "picture": chosen["picture"]}
    return {name: value for name, value in nested.items() if name in kind.__dataclass_fields__}


def make_settings(command: str, values: dict[str, Any]) -> Command:
    """Make the settings of a command, and check the values. This does not import torch."""
    kind = WITH_SETTINGS[command]
    if "picture" in values:
        kind = PICTURES[values["picture"]]
    made = dict(values)
    if "model" in values:
        made["model"] = config_from(values["model"])
    engine = values.get("engine")
    if engine is not None:
        if engine["name"] not in ENGINES:
            raise CFlowError(f"engine={engine['name']!r}: give one of {', '.join(ENGINES)}")
        made["engine"] = _make(ENGINES[engine["name"]], engine, command)
    for name, value in values.get("data", {}).items():
        if name in DATA_SETTINGS and value != NOT_GIVEN:
            checked(f"data.{name}", value, DATA_SETTINGS[name])
    return _make(kind, made, command)  # type: ignore[return-value]


def _make(kind: type[Settings], values: dict[str, Any], command: str) -> Settings:
    for name in values:
        if name not in kind.__dataclass_fields__:  # type: ignore[attr-defined]
            raise CFlowError(f"unknown setting {kind.PREFIX}{name}: `cflow {command} --cfg job` prints all settings")
    return kind(**values)


def _chosen(settings: list[str], kind: type[Command]) -> dict[str, list[str]]:
    """Return the checked choices of each group; none if they are not known, as those of an experiment."""
    given = dict(word.split("=", 1) for word in settings if "=" in word)
    chosen: dict[str, list[str]] = {}
    for group, default in kind.groups().items():
        chosen[group] = [default] if default else []
    for group in chosen.keys() & given.keys():
        is_plain = not set(given[group]) & set(_NOT_PLAIN)
        chosen[group] = [word.strip() for word in given[group].split(",")] if is_plain else []
        known = choices(group)
        for choice in chosen[group]:
            if choice not in known:
                raise CFlowError(f"{group}={choice}{near(choice, known)}: give one of {', '.join(sorted(known))}")
    if "experiment" in given or "row" in given:
        return {group: [] for group in chosen}
    if "model" not in given and "picture" in given:
        chosen["model"] = [PICTURES[name].PRESET or "default" for name in chosen["picture"]]
    return chosen


def _is_for_hydra(key: str) -> bool:
    """Test whether a key adds or removes a setting, moves a group, or is a setting of Hydra itself."""
    return key.startswith(("+", "~", "hydra")) or "@" in key


def check_exists(path: str) -> None:
    """Reject a path that does not exist. The address of an object store is not looked up."""
    if "://" not in path and not os.path.exists(path):
        raise CFlowError(f"{path}: there is no such file or folder; settings are NAME=VALUE")
