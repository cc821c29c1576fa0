"""Names that come from data (log ids, scene names, file names in tables): one rule for all of them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from cflow_torch.types import CFlowError

MAX_NAME_BYTES = 255  # of one folder or file, in UTF-8: what file systems take
# No dot in front (hidden), no drive, no separator of any system, no device of Windows, no dot or blank at the end:
# outputs are copied to other systems.
_NAME = re.compile(r"(?!\.|[A-Z]:|(CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(COM|LPT)[0-9]) *(\.|$))[^/\\]*[^/\\. ]", re.I)
_RULE = "names are up to 255 bytes, without / and \\, dots in front, dots or blanks behind, and no device (C:, CON)"
_SHOWN = 80  # characters of a name in a message


def is_safe_name(name: Any) -> bool:
    """Whether it is the name of one file or folder on every system."""
    if not isinstance(name, str) or not name.isprintable() or not _NAME.fullmatch(name):
        return False
    return len(name.encode()) <= MAX_NAME_BYTES


def safe_name(name: Any, what: str) -> str:
    """The name of one file or folder, if it is one on every system and stays where it is put.

    Args:
        name: from data.
        what: what it is the name of, for the message.

    Returns:
        The same name.

    Raises:
        CFlowError: `is_safe_name` says no.
    """
    if not is_safe_name(name):
        shown = ascii(name)[: _SHOWN + 2] if isinstance(name, str) else f"a {type(name).__name__}"
        raise CFlowError(f"{what} {shown} is no folder name and no file name: {_RULE}; rename it in the data")
    return str(name)


def path_inside(folder: Path, relative: Any, what: str) -> Path:
    """Where a name from a table lies: below a folder. Links below it are followed: the user laid out the data so.

    Args:
        folder: of the data set.
        relative: from a table, folders separated by /.
        what: what it is the name of, for the message.

    Raises:
        CFlowError: no text, empty, absolute, or a part that `safe_name` refuses, `..` among them.
    """
    parts = relative.split("/") if isinstance(relative, str) else [""]
    named = [part for part in parts if part not in ("", ".")]
    if not parts[0] or not named or not all(map(is_safe_name, named)):
        shown = ascii(relative)[:_SHOWN]
        raise CFlowError(f"{what} {shown} is not read: it must name a file below {folder}; {_RULE}")
    return folder.joinpath(*named)


def folder_in(output: Path, name: Any, what: str) -> Path:
    """The folder `output/<name>` to write into.

    Args:
        output: folder of the run.
        name: from data.
        what: what it is the name of, for the message.

    Raises:
        CFlowError: `safe_name` refuses the name.
    """
    return output / safe_name(name, what)


def is_timestamp(name: str) -> bool:
    """Whether a name is a time stamp: digits 0 to 9 that an int64 can hold."""
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63
