"""How a command ends that was called wrongly, or whose file or reader is refused."""

from __future__ import annotations

import os
import sys


class UnfinishedJob(RuntimeError):
    """Something is missing, and a message says what. The other jobs of a sweep still run."""


def exit_wrong(message: object) -> None:
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2) from None


def exit_if_refused(error: Exception) -> None:
    """Exit after an error that is not a bug: a file that the system refused, or a pipe whose reader has ended."""
    if isinstance(error, BrokenPipeError):  # as in `cflow info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(128 + 13) from None  # as if SIGPIPE had ended it
    if isinstance(error, OSError) and error.filename is not None:
        exit_wrong(f"{error.filename}: {error.strerror or error}; check data.root= (read) and output= (written)")
