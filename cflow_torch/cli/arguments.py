"""Translate the arguments of a command into the syntax of Hydra's parser, and check them without Hydra and torch.

Hydra and torch take seconds to import, so a wrong path, preset or option is answered before. Calls with Hydra's own
syntax or with configurations of your own are left to Hydra, and so is every value that is more than a number, a word or
a list of them.
"""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

from cflow_torch.cli.choices import CONFIGS, defaults, files, groups, near, own_settings, settings
from cflow_torch.cli.refusals import unknown_choice, unknown_setting
from cflow_torch.config import PRESETS, make_config
from cflow_torch.errors import CFlowError

# Settings that name a file, a folder or a log. Their values are text, even if they look like a number.
_NAMES = ("output", "log", "flow", "archive", "frames", "masks", "result_name", "data.root", "data.cache")
# Hydra reads these values as numbers or booleans: 1e5, 2024_11_22, true.
_NOT_TEXT = re.compile(r"[+-]?[._]*\d[\d._]*(e[+-]?[\d_]+)?|true|false", re.IGNORECASE)
_READABLE = re.compile(r"[\w./\\:+%@?|*$ -]*", re.ASCII)  # without quotes
_WITH_VALUE = ("-c", "--cfg", "-p", "--package", "-i", "--info", "-cd", "--config-dir", "-cn", "--config-name", "-cp")
_GRAMMAR = re.compile(r"['\"\[{]|(choice|glob|range|shuffle|sort|str|tag)\(|.*\$\{")  # Hydra's own syntax
_LONG = (
    *("--help", "--hydra-help", "--version", "--cfg", "--resolve", "--package", "--run", "--multirun", "--info"),
    *("--shell-completion", "--config-path", "--config-name", "--config-dir", "--experimental-rerun"),
)
_SHORT = ("-h", "-c", "-p", "-r", "-m", "-s", "-i")  # with a value: -cjob; also -sc, -cp, -cn, -cd
_OWN_CONFIG = re.compile(r"--config-|-c[pnd]")
_INPUTS = ("data.root", "archive", "frames", "masks")  # local files that exist
_ONE_PATH = re.compile(r'"((?:[^"\\]|\\.)*)"|([^"\'\[{(,$]*)')  # in quotes or without
_NUMBER = re.compile(r"[+-]?(\d+|\d*\.\d+|\d+\.|inf)")


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Split the arguments of a command into settings, with quoted names, and options with their values.

    Hydra accepts them in this order only: no `-m` between two settings.

    Args:
        arguments: a path by itself means data.root. Without quotes, Hydra would read the Waymo segment
            log=10203656353524179475_7625_000_7645_000 as a whole number, and reject output=Ausgänge.
    """
    overrides, options = [], []
    for before, word in zip(["", *arguments], arguments):
        if word.startswith("-") or before in _WITH_VALUE:
            options.append(word)
        elif "=" in word or word[0:1] in ("+", "~"):
            overrides.append(_quoted(word))
        else:
            overrides.append(f"data.root={_text(word)}")
    return overrides, options


def fixed_settings(overrides: list[str]) -> list[str]:
    """Names of the settings with one value, by which the jobs of a sweep do not differ."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import OverrideParseException

    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
    except OverrideParseException:  # Hydra meets the error again and reports it
        return []
    return [str(one.key_or_group) for one in parsed if not one.is_sweep_override() and not one.is_hydra_override()]


def _quoted(override: str) -> str:
    key, _, value = override.partition("=")
    if key.lstrip("+") not in _NAMES or _GRAMMAR.match(value):
        return override
    values = value.split(",")  # of a sweep
    is_quoted = [_NOT_TEXT.fullmatch(one.strip()) or not _READABLE.fullmatch(one) for one in values]
    return f"{key}={','.join(_text(one) if quoted else one for one, quoted in zip(values, is_quoted))}"


def _text(value: str) -> str:
    return '"' + value.replace('"', r"\"") + '"'


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
