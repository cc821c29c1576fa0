"""Translate the arguments of a command into the syntax of Hydra's parser."""

from __future__ import annotations

import re

# Settings that name a file, a folder or a log. Their values are text, even if they look like a number.
_NAMES = ("output", "log", "flow", "archive", "frames", "masks", "result_name", "data.root", "data.cache")
# Hydra reads these values as numbers or booleans: 1e5, 2024_11_22, true.
_NOT_TEXT = re.compile(r"[+-]?[._]*\d[\d._]*(e[+-]?[\d_]+)?|true|false", re.IGNORECASE)
_READABLE = re.compile(r"[\w./\\:+%@?|*$ -]*", re.ASCII)  # without quotes
_WITH_VALUE = ("-c", "--cfg", "-p", "--package", "-i", "--info", "-cd", "--config-dir", "-cn", "--config-name", "-cp")
_GRAMMAR = re.compile(r"['\"\[{]|(choice|glob|range|shuffle|sort|str|tag)\(|.*\$\{")  # Hydra's own syntax


def split(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Split the arguments of a command into settings, with quoted names, and options with their values.

    Hydra accepts them in this order only: no `-m` between two settings. A path by itself means data.root. Without
    quotes, Hydra would read the Waymo segment log=10203656353524179475_7625_000_7645_000 as a whole number, and reject
    output=Ausgänge.
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
    """Return the names of the settings that have one value, so that all jobs of a sweep share it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import OverrideParseException

    try:
        parsed = OverridesParser.create().parse_overrides(overrides)
    except OverrideParseException:  # Hydra meets the error again and reports it
        return []
    return [str(one.key_or_group) for one in parsed if not one.is_sweep_override() and not one.is_hydra_override()]


def unknown_options(options: list[str]) -> list[str]:
    """Options from `split` that Hydra does not have."""
    from hydra._internal.utils import get_args_parser

    return get_args_parser().parse_known_args(options)[1]


def _quoted(override: str) -> str:
    key, _, value = override.partition("=")
    if key.lstrip("+") not in _NAMES or _GRAMMAR.match(value):
        return override
    values = value.split(",")  # of a sweep
    is_quoted = [_NOT_TEXT.fullmatch(one.strip()) or not _READABLE.fullmatch(one) for one in values]
    return f"{key}={','.join(_text(one) if quoted else one for one, quoted in zip(values, is_quoted))}"


def _text(value: str) -> str:
    return '"' + value.replace('"', r"\"") + '"'
