"""Names that come from data (log ids, scene names, file names in tables) must stay in their folder."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from cflow_torch.errors import CFlowError

_NAME = re.compile(r"(?!\.|[A-Za-z]:)[^/\\]+")  # not hidden, no `..`, no drive, no separator of any system
_RULE = "a name has no / or \\, no control characters, no dot in front and no drive (C:)"
_SHOWN = 80  # characters of a name in a message


def is_safe_name(name: Any) -> bool:
    """Test whether a value from data can name one file or folder that stays in its folder."""
    return isinstance(name, str) and name.isprintable() and _NAME.fullmatch(name) is not None


def safe_name(name: Any, what: str) -> str:
    """Return a name from data, or raise a `CFlowError` that begins with `what` if it is not a safe name."""
    if not is_safe_name(name):
        shown = ascii(name)[: _SHOWN + 2] if isinstance(name, str) else f"a {type(name).__name__}"
        raise CFlowError(f"{what} {shown} cannot be used as a file or folder name: {_RULE}; rename it in the data")
    return str(name)


def path_inside(folder: Path, relative: Any, what: str) -> Path:
    """Return the path of a file that a table names, below a folder. Links are followed: users link data sets.

    A text that is empty or absolute, or has a name that is not safe, such as `..`, is a `CFlowError` that begins with
    `what`.
    """
    names = relative.split("/") if isinstance(relative, str) else [""]
    named = [name for name in names if name not in ("", ".")]
    if not names[0] or not named or not all(map(is_safe_name, named)):
        shown = ascii(relative)[:_SHOWN]
        raise CFlowError(f"{what} {shown} is not read: it must name a file below {folder}; {_RULE}")
    return folder.joinpath(*named)


def is_timestamp(name: str) -> bool:
    """Test whether a name is a time stamp: digits 0 to 9 that an int64 can hold."""
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63
