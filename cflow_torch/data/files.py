"""Shared by the readers: one error for every file that cannot be read, .npy files, and the search for logs."""

from __future__ import annotations

import io
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

import numpy as np

from cflow_torch.data.paths import read_bytes
from cflow_torch.errors import CFlowError

Test = Callable[[Path], bool]
_MAX_TEXT = 400  # characters of a library's message; a damaged name can be a million characters long


@contextmanager
def file_errors(file: Any, hint: str = "copy it again", doing: str = "read") -> Iterator[None]:
    """Turn any exception of the block into one `CFlowError` that names the file.

    Libraries raise nearly anything for a damaged file (OSError, ValueError, KeyError, struct.error, MemoryError, ...).

    Args:
        file: a path, or a text that begins with one.
        hint: what the user can do; it ends the message.
        doing: what is done with the file, for the message.
    """
    try:
        yield
    except CFlowError as error:
        if str(file) in str(error):
            raise
        raise CFlowError(f"{file}: {error}") from error
    except FileNotFoundError:
        raise CFlowError(f"{file} is missing; {hint}") from None
    except Exception as error:
        cause = f"{type(error).__name__}: {shortened(error)}"
        guess = "it may be truncated or damaged, " if doing == "read" else ""
        raise CFlowError(f"cannot {doing} {file} ({cause}); {guess}{hint}") from error


def shortened(text: Any) -> str:
    """Return the text on one line of at most 400 characters."""
    line = " ".join(str(text).split())
    return line if len(line) <= _MAX_TEXT else line[:_MAX_TEXT] + " ..."


def check_columns(file: Any, names: Sequence[str], columns: Sequence[str], hint: str = "copy it again") -> None:
    """Raise a `CFlowError` if a needed column is missing or occurs several times; `hint` ends the message."""
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(f"{file} lacks the columns {missing}; it has {shortened(names)}; {hint}")
    repeated = [name for name in columns if names.count(name) > 1]
    if repeated:
        raise CFlowError(f"{file} has several columns {repeated}; keep one of each")


def read_npy(path: Path, hint: str) -> np.ndarray:
    """Read the array of a .npy file; pickled objects are never loaded. Errors as in `file_errors`."""
    with file_errors(path, hint):
        array = np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive, not a .npy file")
        return array


def find_folders(root: Path, is_log: Test, depth: int, what: str, is_passed: Test = lambda folder: True) -> list[Path]:
    """Find the folders that are logs, `root` among them, sorted. Folders below a log and hidden ones are not searched.

    Args:
        root: where the search begins; a path that is not a folder is a `CFlowError`.
        is_log: whether a folder is a log.
        depth: levels below `root` that are searched.
        what: what the user should pass instead, for the error.
        is_passed: whether to search a folder.
    """
    if not root.is_dir():
        raise CFlowError(f"{root} is not a folder; pass {what}")
    found: list[Path] = []
    level = [root]
    for _ in range(depth + 1):
        logs = {folder for folder in level if is_log(folder)}
        found += logs
        children = (child for folder in level if folder not in logs for child in folder.iterdir())
        level = [c for c in children if not c.name.startswith(".") and is_passed(c) and c.is_dir()]
    return sorted(found)
