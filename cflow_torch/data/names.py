"""Names that come from data: what may become a file's or a folder's name, and where it may lie.

Log ids, scene names, tokens and file names in tables are text that somebody else wrote. One rule for all of them.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections import Counter
from pathlib import Path
from typing import Any, Iterable, List

from cflow_torch.data.paths import is_remote
from cflow_torch.types import CFlowError

MAX_NAME_BYTES = 255  # of one folder or file, in UTF-8: what file systems take
_MAX_DEPTH = 64  # folders in one name of a table
_SEPARATOR = re.compile(r"[/\\]|^[A-Za-z]:")  # also those of other systems: outputs are copied there
# Windows opens a device instead of a file for these, whatever follows the first dot.
_RESERVED = re.compile(r"(CON|PRN|AUX|NUL|CONIN\$|CONOUT\$|(COM|LPT)[0-9\u00b9\u00b2\u00b3]) *(\..*)?", re.I | re.S)
_SHOWN = 80  # characters of a name in a message


def safe_name(name: Any, what: str) -> str:
    """The name of one file or folder, if it is one on every system and stays where it is put.

    Args:
        name: from data.
        what: what it is the name of, for the message.

    Returns:
        The same name.

    Raises:
        CFlowError: no text, empty, begins with a dot (`..`, hidden ones), has a separator (/, \\, C:), a control
            character (NUL, line ends) or a lone surrogate, ends in a dot or blank, is reserved on Windows (CON,
            aux.txt), or has over 255 bytes.
    """
    why = _fault(name)
    if why:
        shown = ascii(name)[: _SHOWN + 2] if isinstance(name, str) else f"a {type(name).__name__}"
        raise CFlowError(f"{what} {shown} is no folder name and no file name: {why}; rename it in the data")
    return str(name)


def is_safe_name(name: Any) -> bool:
    """Whether `safe_name` takes it."""
    return not _fault(name)


def inside(folder: Path, relative: Any, what: str) -> Path:
    """Where a name from a table lies: below a folder.

    Links below the folder are followed: they are how the user laid out the data.

    Args:
        folder: of the data set.
        relative: from a table, folders separated by /.
        what: what it is the name of, for the message.

    Raises:
        CFlowError: no text, absolute, or a part that `safe_name` refuses, `..` among them.
    """
    if not isinstance(relative, str):
        raise CFlowError(f"{what} is a {type(relative).__name__}, expected the name of a file")
    parts = [part for part in relative.split("/") if part not in ("", ".")]
    if relative.startswith(("/", "\\")) or ".." in parts:
        raise CFlowError(f"{what} {ascii(relative)[:_SHOWN]} leaves {folder}: it must be a name below that folder")
    if not 0 < len(parts) <= _MAX_DEPTH:
        raise CFlowError(f"{what} {ascii(relative)[:_SHOWN]} has {len(parts)} parts, expected 1 to {_MAX_DEPTH}")
    for part in parts:
        if _fault(part):
            raise CFlowError(
                f"{what} {ascii(relative)[:_SHOWN]} is not read: of {ascii(part)[:_SHOWN]}, {_fault(part)}"
            )
    return folder.joinpath(*parts)


def folder_in(output: Path, name: Any, what: str) -> Path:
    """The folder `output/<name>` to write into.

    Args:
        output: folder of the run; may be a link itself, and may not be there yet.
        name: from data.
        what: what it is the name of, for the message.

    Raises:
        CFlowError: `safe_name` refuses the name; or it is a link that leaves `output`, so that others' files would be
            written or removed.
    """
    folder = output / safe_name(name, what)
    if leaves(output, folder):
        raise CFlowError(
            f"{folder} is a link to {os.path.realpath(folder)}, outside of {output}: nothing is written there; "
            "remove the link, or give output=FOLDER"
        )
    return folder


def leaves(output: Path, path: Path) -> bool:
    """Whether a path in a folder is a link, or lies behind one, that leads out of it."""
    if is_remote(output):
        return False
    root, real = os.path.realpath(output), os.path.realpath(path)
    return real != root and not real.startswith(root.rstrip(os.sep) + os.sep)


def is_stamp(name: str) -> bool:
    """Whether a name is a time stamp: digits 0 to 9 that an int64 can hold."""
    return name.isascii() and name.isdigit() and len(name) < 20 and int(name) < 1 << 63


def same_names(names: Iterable[str]) -> List[str]:
    """Names that some file system cannot tell from another one of them: the same but for case or Unicode form."""
    listed = list(names)
    keys = [unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold()) for name in listed]
    count = Counter(keys)
    return sorted({name for name, key in zip(listed, keys) if count[key] > 1})


def _fault(name: Any) -> str:
    """What is wrong with the name of one file; "" if nothing is."""
    if not isinstance(name, str):
        return "it is no text"
    if name in ("", ".", ".."):
        return "it names no file of its own"
    if name[0] == ".":
        return "it begins with a dot, so it would be hidden, and passed over"
    if _SEPARATOR.search(name):
        return "it has a separator of folders or a drive"
    if any(unicodedata.category(letter) in ("Cc", "Cs", "Zl", "Zp") for letter in name):
        return "it has a control character or half of a surrogate pair"
    if name[-1] in ". ":
        return "it ends in a dot or blank, which Windows leaves out"
    if _RESERVED.fullmatch(name):
        return "it is a device on Windows"
    size = len(name.encode())
    return f"it has {size} bytes, more than {MAX_NAME_BYTES}" if size > MAX_NAME_BYTES else ""
