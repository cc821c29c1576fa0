"""Check a call without Hydra and torch, whose import takes seconds: a wrong path, preset or option is answered at once.

Calls with Hydra's own syntax or with configurations of your own are left to Hydra, and so is every value that is more
than a number, a word or a list of them.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from cflow_torch.cli.arguments import split
from cflow_torch.cli.choices import CONFIGS, defaults, files, groups, near, own_settings, settings
from cflow_torch.cli.refusals import unknown_choice, unknown_setting
from cflow_torch.config import PRESETS, make_config
from cflow_torch.errors import CFlowError

_LONG = (
    *("--help", "--hydra-help", "--version", "--cfg", "--resolve", "--package", "--run", "--multirun", "--info"),
    *("--shell-completion", "--config-path", "--config-name", "--config-dir", "--experimental-rerun"),
)
_SHORT = ("-h", "-c", "-p", "-r", "-m", "-s", "-i")  # with a value: -cjob; also -sc, -cp, -cn, -cd
_OWN_CONFIG = re.compile(r"--config-|-c[pnd]")
_INPUTS = ("data.root", "archive", "frames", "masks")  # local files that exist
_ONE_PATH = re.compile(r'"((?:[^"\\]|\\.)*)"|([^"\'\[{(,$]*)')  # in quotes or without
_NUMBER = re.compile(r"[+-]?(\d+|\d*\.\d+|\d+\.|inf)")


def check_call(command: str, arguments: list[str]) -> None:
    """Check the arguments of a command as far as possible without Hydra.

    Raises:
        CFlowError: an unknown option, setting or choice, a path that does not exist, or an invalid setting of a method.
    """
    overrides, options = split(arguments)
    for option in options:
        if option.startswith("-"):
            _check_option(option, command)
    is_own = any(map(_OWN_CONFIG.match, options)) or any(word.startswith("hydra.searchpath=") for word in overrides)
    if is_own or any(word[0] in "+~" for word in overrides):
        return
    given = dict(word.partition("=")[::2] for word in overrides if not word.startswith("hydra"))
    choices = groups(command)
    chosen = {**defaults(command), **{name: given[name] for name in given if name in choices}}
    for group, value in chosen.items():
        for name in value.split(",") if value and re.fullmatch(r"[\w,]+", value) else ():
            if name not in (*choices[group], "null"):
                raise CFlowError(unknown_choice(group, name, choices[group]))
    is_plain = chosen["model"] in PRESETS and not chosen.get("experiment") and not chosen.get("row")
    preset = chosen["model"] if is_plain else None
    known = {*choices, *settings(command)}
    if chosen.get("picture") in choices.get("picture", ()):
        own = own_settings(CONFIGS / "picture" / f"{chosen['picture']}.yaml")
        known -= {name for file in files("picture") for name in own_settings(file)} - set(own)
    for key in given:
        if not any(f"{name}.".startswith(f"{key}.") for name in known):
            raise CFlowError(unknown_setting(key, preset and PRESETS[preset][0], command))
    if preset is not None:
        _check_model(preset, {key[6:]: value for key, value in given.items() if key.startswith("model.")})
    if set(options) <= {"-m", "--multirun"}:  # others print settings
        _check_inputs(given, arguments)
        file = CONFIGS / "data" / f"{chosen['data']}.yaml"
        if "data.root" not in given and file.exists() and own_settings(file).get("root") == "???":
            raise CFlowError("the data is missing: give data.root=PATH, or only the path")


def _check_option(word: str, command: str) -> None:
    name = word.partition("=")[0]
    if not any(long.startswith(name) for long in _LONG) if word.startswith("--") else not word.startswith(_SHORT):
        hint = near(name, (*_LONG, *(f"--{key}" for key in settings(command))))
        raise CFlowError(
            f"unknown option {word!r}{hint}: give settings as NAME=VALUE; `cflow {command} --help` lists them"
        )


def _check_inputs(given: dict[str, str], arguments: list[str]) -> None:
    for key in _INPUTS:
        found = _ONE_PATH.fullmatch(given.get(key, ""))
        if found is None:
            continue
        path = found[2] if found[1] is None else found[1].replace(r"\"", '"')
        if path not in ("", "null") and "://" not in path and not Path(path).exists():
            what = f"{path}: there is" if path in arguments else f"{key}={path}: there is"
            raise CFlowError(f"{what} no such file or folder; settings are NAME=VALUE")


def _check_model(preset: str, given: dict[str, str]) -> None:
    """Check the settings of a method whose values can be read."""
    config, values = make_config(preset), {}
    kinds = {f.name: f.metadata["kind"] for f in fields(config)}
    for name, text in given.items():
        if name not in kinds:
            config.replace(**{name: None})  # raises the error that names the method of this setting
        if kinds[name] is not bool and name != "method":
            with suppress(ValueError):
                values[name] = _read(text)
    config.replace(**values)


def _read(text: str) -> Any:
    """Read a number, a word, null or a list of them as Hydra does; `ValueError` for everything else."""
    if text.startswith("[") and text.endswith("]"):
        return [_read(word.strip()) for word in text[1:-1].split(",")]
    if text == "null":
        return None
    if _NUMBER.fullmatch(text):
        return int(text) if text.lstrip("+-").isdigit() else float(text)
    if re.fullmatch(r"[a-z]\w*", text) and text not in ("true", "false"):
        return text
    raise ValueError(text)
