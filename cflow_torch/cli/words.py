"""The words after `cflow COMMAND`: settings, paths and options, and a check of their names.

We do not import Hydra here, so that a mistyped name is told at once.
"""

from __future__ import annotations

import glob
import os
from typing import NamedTuple

from cflow_torch.cli.choices import choices, near, setting_names
from cflow_torch.cli.commands import WITH_SETTINGS
from cflow_torch.config import REMOVED, REMOVED_PRESETS, removed_preset
from cflow_torch.errors import CFlowError

# Options of Hydra that the next word belongs to; the first of them name configurations of your own.
_OWN_CONFIGS = ("-cd", "--config-dir", "-cn", "--config-name", "-cp", "--config-path")
_WITH_VALUE = (*_OWN_CONFIGS, "-c", "--cfg", "-p", "--package", "-i", "--info")
_FLAGS = ("-m", "--multirun", "-r", "--run", "--resolve", "--hydra-help", "--version", "-sc", "--shell-completion")
_NOT_PLAIN = "'\"[{(*$"  # characters by which a value is a list, a text, a function or a reference of Hydra's
# Settings of commands that earlier versions had; for those of the methods, see `config.REMOVED`.
_REMOVED = {**REMOVED, "standing": "use remove_stopped", "residual_axes": "leave it out"}


class Call(NamedTuple):
    """The words of a call. A word without "=" is a path."""

    settings: list[str]
    paths: list[str]
    options: list[str]


def read_call(words: list[str], command: str) -> Call:
    """Read the words after a command. An option, a path or a name that does not exist is a `CFlowError`.

    Names in your own configurations, with `--config-dir`, are not known here.
    """
    call = split(words)
    given = {option.partition("=")[0] for option in call.options if option.startswith("-")}
    for option in given - {*_FLAGS, *_WITH_VALUE}:
        raise CFlowError(f"unknown option {option!r}: give settings as NAME=VALUE; `cflow {command} --help` lists them")
    for path in call.paths if not given & {"-c", "--cfg"} else ():  # these only print the settings
        check_exists(path)
    if not given & set(_OWN_CONFIGS):
        _check_names(call.settings, command)
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


def _check_names(settings: list[str], command: str) -> None:
    groups = WITH_SETTINGS[command].groups()
    known = setting_names(WITH_SETTINGS[command])
    for word in settings:
        key, _, value = word.partition("=")
        if key in groups:
            if not set(value) & set(_NOT_PLAIN):
                for choice in value.split(","):
                    _check_choice(key, choice.strip())
        elif not (_is_for_hydra(key) or key in known or any(one.startswith(f"{key}.") for one in known)):
            raise CFlowError(_unknown(key, command, [*groups, *known]))


def _is_for_hydra(key: str) -> bool:
    """Test whether a key adds or removes a setting, moves a group, or is a setting of Hydra itself."""
    return key.startswith(("+", "~", "hydra")) or "@" in key


def check_exists(path: str) -> None:
    """Reject a path that does not exist. The address of an object store is not looked up."""
    if "://" not in path and not os.path.exists(path):
        raise CFlowError(f"{path}: there is no such file or folder; settings are NAME=VALUE")


def _check_choice(group: str, choice: str) -> None:
    if group == "model" and choice in REMOVED_PRESETS:
        raise CFlowError(removed_preset(choice))
    known = choices(group)
    if choice not in (*known, "null") and not choice.startswith("base_"):
        raise CFlowError(f"{group}={choice}{near(choice, known)}: give one of {', '.join(sorted(known))}")


def _unknown(key: str, command: str, known: list[str]) -> str:
    own = key.rpartition(".")[2]
    if own in _REMOVED:
        return f"setting {own} was removed: {_REMOVED[own]}"
    return f"unknown setting {key!r}{near(key, known)}: `cflow {command} --cfg job` prints all settings"


def why_rejected(key: str, command: str) -> str:
    """Return the message for a setting that the chosen groups do not have."""
    known = setting_names(WITH_SETTINGS[command])
    if key not in known:
        return _unknown(key, command, [*WITH_SETTINGS[command].groups(), *known])
    owners = known[key]
    if 0 < len(owners) <= 4:
        return f"setting {key!r} belongs to {' or '.join(owners)}: give that as well, or leave the setting out"
    return f"the chosen configuration has no setting {key!r}: give +{key}=VALUE to add it, or leave it out"
