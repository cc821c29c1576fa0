"""The error and warning classes of the package. We do not import torch here, so `cflow` rejects wrong calls fast."""

from __future__ import annotations

import re
import sys
import warnings
from difflib import get_close_matches
from importlib import import_module
from typing import Any, Iterable

_NOT_OF_USERS = ("cflow_torch", "torch", "contextlib")  # packages between the user's code and a warning


class CFlowError(ValueError):
    """The only error that this package raises for bad input, bad files and bad settings.

    The message says what you passed, what is allowed, and what to do.
    """


class MissingFile(CFlowError):
    """A file does not exist."""


class CFlowWarning(UserWarning):
    """Input that is allowed, but likely a mistake."""


def near(word: str, known: Iterable[str]) -> str:
    """Return the hint " (did you mean X?)", "" if no name is similar.

    We compare names with and without their group, such as "model.", and prefer one that has the word as a part.
    """
    names = {form: name for name in known for form in (name.rpartition(".")[2], name)}
    whole = [form for form in names if word in re.split("[._]", form)]
    similar = whole or get_close_matches(word, names, 1)
    return f" (did you mean {names[similar[0]]}?)" if similar else ""


def import_optional(module: str, need: str, name: str | None = None) -> Any:
    """Import a module that may be missing, or a name from it.

    If it is missing, that is a `CFlowError` with the message `need`, which says how to install it.
    """
    try:
        return getattr(import_module(module), name) if name else import_module(module)
    except (ImportError, AttributeError) as error:
        raise CFlowError(need) from error


def warn(text: str) -> None:
    """Give a `CFlowWarning`, and name the line of the user's code that called the package."""
    level = 2
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in _NOT_OF_USERS:
        level = level + 1
        frame = frame.f_back
    warnings.warn(text, CFlowWarning, stacklevel=level)
