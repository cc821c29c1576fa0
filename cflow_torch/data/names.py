"""Names that come from data (log ids, scene names, file names in tables): one rule for all of them."""

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
        CFlowError: no text, empty, begins with a dot, has a separator (/, \\, C:), a control character or a lone
            surrogate, ends in a dot or blank, is reserved on Windows (CON, aux.txt), or has over 255 bytes.
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
    """Where a name from a table lies: below a folder. Links below it are followed: the user laid out the data so.

    Args:
        folder: of the data set.
        relative: from a table, folders separated by /.
        what: what it is the name of, for the message.

    Raises:
        CFlowError: no text, empty, absolute, or a part that `safe_name` refuses, `..` among them.
    """
    parts = relative.split("/") if isinstance(relative, str) else []
    named = [part for part in parts if part not in ("", ".")]
    fault = next(filter(None, map(_fault, named)), "" if named else "it names no file")
    if parts and (not parts[0] or ".." in parts):
        fault = f"it leaves {folder}"
    if fault:
        raise CFlowError(f"{what} {ascii(relative)[:_SHOWN]} is not read: {fault}; give a name below {folder}")
    return folder.joinpath(*named)


def folder_in(output: Path, name: Any, what: str) -> Path:
    """The folder `output/<name>` to write into.

    Args:
        output: folder of the run; may be a link itself, and may not be there yet.
        name: from data.
        what: what it is the name of, for the message.

    Raises:
        CFlowError: `safe_name` refuses the name, or it is a link that leaves `output`.
    """
    folder = output / safe_name(name, what)
    if leaves(output, folder):
        where = f"{folder} is a link to {os.path.realpath(folder)}, outside of {output}"
        raise CFlowError(f"{where}: nothing is written there; remove the link, or give output=FOLDER")
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
