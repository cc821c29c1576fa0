"""One error for whatever a library raises about a file: it names the file and says what to do."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any, Iterator, Sequence

from cflow_torch.errors import CFlowError, MissingFile

_MAX_TEXT = 400  # characters of a library's message; a damaged name can be a million characters long


@contextmanager
def file_errors(file: Any, hint: str = "copy it again", doing: str = "read") -> Iterator[None]:
    """Turn any exception of the block into one `CFlowError` that names the file.

    Libraries raise nearly anything for a damaged file (OSError, ValueError, KeyError, struct.error, MemoryError, ...).
    `file` is a path, or a text that begins with one. `hint` says what the user can do; `doing` is "read" or "write".
    """
    try:
        yield
    except CFlowError as error:
        if str(file) in str(error):
            raise
        raise CFlowError(f"{file}: {error}") from error
    except FileNotFoundError:
        raise MissingFile(f"{file} is missing; {hint}") from None
    except Exception as error:
        cause = f"{type(error).__name__}: {shortened(error)}"
        guess = "it may be truncated or damaged, " if doing == "read" else ""
        raise CFlowError(f"cannot {doing} {file} ({cause}); {guess}{hint}") from error


def shortened(text: Any, longest: int = _MAX_TEXT) -> str:
    """Return the text on one line of at most so many characters."""
    line = " ".join(str(text).split())
    return line if len(line) <= longest else line[:longest] + " ..."


def check_columns(file: Any, names: Sequence[str], columns: Sequence[str], hint: str = "copy it again") -> None:
    """Raise a `CFlowError` if a needed column is missing or occurs several times; `hint` ends the message."""
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(f"{file} lacks the columns {missing}; it has {shortened(names)}; {hint}")
    repeated = [name for name in columns if names.count(name) > 1]
    if repeated:
        raise CFlowError(f"{file} has several columns {repeated}; keep one of each")
