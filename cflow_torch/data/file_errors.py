"""One error for every file that cannot be read, whichever library reads it."""

from __future__ import annotations

from contextlib import contextmanager
from typing import Any, Iterator

from cflow_torch.types import CFlowError

_MAX_TEXT = 400  # characters of what a library says; a damaged name can be a million long


@contextmanager
def file_errors(file: Any, hint: str = "copy it again", doing: str = "read") -> Iterator[None]:
    """Turns whatever is raised while a file is read into one `CFlowError` that names the file.

    Libraries raise nearly anything for a damaged file (OSError, ValueError, KeyError, struct.error, MemoryError, ...).

    Args:
        file: what is read: a path, or a text that begins with one.
        hint: what to do about it, the end of the message.
        doing: what is done with the file, for the message.

    Raises:
        CFlowError: as said.
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
        said = f"{type(error).__name__}: {shortened(error)}"
        guess = "it may be truncated or damaged, " if doing == "read" else ""
        raise CFlowError(f"cannot {doing} {file} ({said}); {guess}{hint}") from error


def shortened(text: Any) -> str:
    """One line, not too long."""
    line = " ".join(str(text).split())
    return line if len(line) <= _MAX_TEXT else line[:_MAX_TEXT] + " ..."
