"""What is typed behind a command, put in the form that Hydra's parser takes."""

from __future__ import annotations

import re

# Settings that name a file, a folder or a log: text, whatever they look like.
_NAMES = ("output", "log", "flow", "archive", "frames", "masks", "result_name", "data.root", "data.cache")
# What Hydra would read as a number or a truth value: 1e5, 2024_11_22, true.
_NO_TEXT = re.compile(r"[+-]?[._]*\d[\d._]*(e[+-]?[\d_]+)?|true|false", re.IGNORECASE)
_READABLE = re.compile(r"[\w./\\:+%@?|*$ -]*", re.ASCII)  # without quotes
_WITH_VALUE = ("-c", "--cfg", "-p", "--package", "-i", "--info", "-cd", "--config-dir", "-cn", "--config-name", "-cp")
_GRAMMAR = re.compile(r"['\"\[{]|(choice|glob|range|shuffle|sort|str|tag)\(|.*\$\{")  # what Hydra gives a meaning


def for_hydra(arguments: list[str]) -> list[str]:
    """Settings before options, since Hydra's parser does not take `-m` between two settings; names in quotes.

    Args:
        arguments: behind the command. A path by itself is data.root. A Waymo segment,
            log=10203656353524179475_7625_000_7645_000, is a whole number to Hydra, which leaves its underscores out,
            and output=Ausgänge an error.
    """
    overrides, options = [], []
    for before, word in zip(["", *arguments], arguments):
        if word.startswith("-") or before in _WITH_VALUE:
            options.append(word)
        elif "=" in word or word[0:1] in ("+", "~"):
            overrides.append(_quoted(word))
        else:
            overrides.append(f"data.root={_text(word)}")
    return overrides + options


def _quoted(override: str) -> str:
    key, _, value = override.partition("=")
    if key.lstrip("+") not in _NAMES or _GRAMMAR.match(value):
        return override
    values = value.split(",")  # of a sweep
    for number, one in enumerate(values):
        if _NO_TEXT.fullmatch(one.strip()) or not _READABLE.fullmatch(one):
            values[number] = _text(one)
    return f"{key}={','.join(values)}"


def _text(value: str) -> str:
    return '"' + value.replace('"', r"\"") + '"'
