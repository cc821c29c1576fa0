"""The words after `cflow COMMAND`: settings, paths and options, and a check of their names.

We do not import Hydra here, so that a mistyped name is told at once.
"""

from __future__ import annotations

import glob
import math
import os
import re
from contextlib import suppress
from typing import Any, Iterable, Mapping, NamedTuple

from cflow_torch.cli.choices import Limits, choices, known_settings
from cflow_torch.cli.commands import PAIR_SETTINGS, PICTURES, WITH_SETTINGS, Command
from cflow_torch.errors import CFlowError, near
from cflow_torch.setting import checked

# Options of Hydra that the next word belongs to; the first of them name configurations of your own.
_OWN_CONFIGS = ("-cd", "--config-dir", "-cn", "--config-name", "-cp", "--config-path")
_WITH_VALUE = (*_OWN_CONFIGS, "-c", "--cfg", "-p", "--package", "-i", "--info")
_FLAGS = ("-m", "--multirun", "-r", "--run", "--resolve", "--hydra-help", "--version", "-sc", "--shell-completion")
_LITERALS = {"null": None, "true": True, "false": False, "inf": math.inf, "nan": math.nan}
_NOT_PLAIN = "'\"[{(*$"  # characters by which a value is a list, a text, a function or a reference of Hydra's
_PLAIN = re.compile(r"[A-Za-z_/][\w./-]*", re.ASCII)  # texts that Hydra reads as text, unless they are `_LITERALS`
_PATHS = {"data.root", "data.cache"}  # text, even if they look like numbers
# Values that Hydra must read by itself: null, a list, a reference, a function, a quoted text.
_SYNTAX = re.compile(
    r"null|\[.*\]|.*\$\{.*\}.*|(choice|range|interval|glob|shuffle|sort|str)\(.*\)|'.*'|\".*\"", re.IGNORECASE
)


class Call(NamedTuple):
    """The words of a call. A word without "=" is a path."""

    settings: list[str]
    paths: list[str]
    options: list[str]


def read_call(words: list[str], command: str) -> tuple[list[str], list[str]]:
    """Return the overrides and the options for Hydra, from the words after a command.

    An option, a path or a name that does not exist is a `CFlowError`.

    With `--config-dir`, your own configurations may have other choices and settings of groups; Hydra knows them.
    """
    kind = WITH_SETTINGS[command]
    call = split(words)
    given = {option.partition("=")[0] for option in call.options if option.startswith("-")}
    for option in given - {*_FLAGS, *_WITH_VALUE}:
        raise CFlowError(f"unknown option {option!r}: give settings as NAME=VALUE; `cflow {command} --help` lists them")
    for path in call.paths if not given & {"-c", "--cfg"} else ():  # these only print the settings
        check_exists(path)
    _check_settings(call.settings, command, bool(given & set(_OWN_CONFIGS)))
    return hydra_overrides(kind, call), call.options


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
    known = known_settings(kind)
    chosen = dict.fromkeys(kind.groups(), []) if has_own else _chosen(settings, kind)
    for word in settings:
        key, _, value = word.partition("=")
        is_group = key in chosen or any(name.startswith(f"{key}.") for name in known)
        if is_group or _is_for_hydra(key) or (has_own and key.partition(".")[0] in chosen):
            continue
        if key not in known:
            hint = _group_of(value, chosen) or near(key, [*chosen, *known])
            raise CFlowError(f"unknown setting {key!r}{hint}: `cflow {command} --cfg job` prints all settings")
        kinds: list[type[Command]] = [kind]
        if "picture" in chosen:
            kinds = [PICTURES[name] for name in chosen["picture"] or PICTURES]
        if key in PAIR_SETTINGS and not any(each.CHOOSES_PAIRS for each in kinds):
            raise CFlowError(f"{key} is for cflow eval, cflow view and cflow plot picture=animation: leave it out")
        _check_value(key, value, known[key], chosen)


def _group_of(value: str, groups: Iterable[str]) -> str:
    """Return the hint that a value is a choice of a group, as in preset=live; "" if it is not."""
    of_value = [group for group in groups if value in choices(group)]
    return f" (did you mean {of_value[0]}={value}?)" if of_value else ""


def _check_value(key: str, value: str, owners: Mapping[str, Limits], chosen: dict[str, list[str]]) -> None:
    """Reject a setting of a choice that is not in effect, and plain values that are not allowed."""
    limits = [limits for choice, limits in owners.items() if _is_chosen(choice, chosen)]
    if not limits:
        raise CFlowError(f"setting {key!r} belongs to {' or '.join(owners)}: give that as well, or leave it out")
    if len(limits) == 1 and limits[0] is not None:
        for plain in plain_values(value, limits[0]["kind"] is str):
            checked(key, plain, limits[0])


def _is_chosen(choice: str, chosen: dict[str, list[str]]) -> bool:
    """Test whether a choice, such as "data=av2", is or may be in effect; "" always is."""
    group, _, name = choice.partition("=")
    return not chosen.get(group) or name in chosen[group]


def plain_values(text: str, is_text: bool = False) -> list[Any]:
    """Return the value that Hydra reads from a text, those of a sweep (a,b), or none if only Hydra can read them.

    With `is_text`, numbers are text, too.
    """
    is_list = text[:1] == "["
    inner = text[1:-1] if is_list else text
    if set(inner) & set(_NOT_PLAIN) or is_list != (text[-1:] == "]"):
        return []
    values = [_plain_value(one.strip(), is_text) for one in inner.split(",")] if inner or not is_list else []
    return [values] if is_list else values


def _plain_value(text: str, is_text: bool) -> Any:
    if text.lower() in _LITERALS and (not is_text or text.lower() == "null"):
        return _LITERALS[text.lower()]
    for kind in () if is_text else (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


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


def hydra_overrides(command: type[Command], call: Call) -> list[str]:
    """Return the settings of a call as Hydra reads them: text in quotes where needed, paths as data.root."""
    texts = set(_PATHS)
    for name, owners in known_settings(command).items():
        if any(limits and limits["kind"] is str for limits in owners.values()):
            texts.add(name)
    overrides = []
    for word in call.settings:
        key, _, value = word.partition("=")
        overrides.append(f"{key}={_as_text(value)}" if key.lstrip("+") in texts else word)
    if len(call.paths) == 1:
        overrides.append(f"data.root={_quoted(call.paths[0])}")
    elif call.paths:
        overrides.append(f"data.root=[{','.join(map(_quoted, call.paths))}]")
    return overrides


def _as_text(value: str) -> str:
    """Quote text, or each text of a sweep (a,b), if Hydra would read another type: the name 1e5 is not a number.

    Other texts stay as they are, because the folder of a job is named after them.
    """
    if _SYNTAX.fullmatch(value):
        return value
    texts = value.split(",")
    return ",".join(
        text if _PLAIN.fullmatch(text) and text.lower() not in _LITERALS else _quoted(text) for text in texts
    )


def _quoted(value: str) -> str:
    """Quote text as Hydra reads it: backslashes are plain, except in front of a quotation mark (C:\\data\\)."""
    return '"' + re.sub(r'(\\*)("|\Z)', _escaped, value) + '"'


def _escaped(match: re.Match[str]) -> str:
    backslashes, mark = match.groups()
    return 2 * backslashes + (r"\"" if mark else "")


def check_exists(path: str) -> None:
    """Reject a path that does not exist. The address of an object store is not looked up."""
    if "://" not in path and not os.path.exists(path):
        raise CFlowError(f"{path}: there is no such file or folder; settings are NAME=VALUE, without spaces")
