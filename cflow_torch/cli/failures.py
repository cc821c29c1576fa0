"""What fails in a run, and how a command ends: the rest of a run goes on, and the exit status tells."""

from __future__ import annotations

import os
import sys
from contextlib import contextmanager
from typing import Iterator, List, Tuple

from cflow_torch.errors import CFlowError
from cflow_torch.fleet.progress import log_line

Failures = List[Tuple[str, str]]  # name of a frame or log, and message


class UnfinishedJob(RuntimeError):
    """Something is missing, and a message says what. The other jobs of a sweep still run."""


def is_sweep() -> bool:
    from hydra.core.hydra_config import HydraConfig  # takes half a second, so not before a call is read
    from hydra.types import RunMode

    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


@contextmanager
def collect_failures(failures: Failures, name: str) -> Iterator[None]:
    """Run a step for one frame or log. If it fails, print the error, append it to `failures`, and continue."""
    try:
        yield
    except (CFlowError, OSError) as error:
        failures.append((name, str(error)))
        log_line(f"failed: {name}: {error}")


def finish(failures: Failures) -> None:
    """Print the failures, and end the command unfinished if there are any."""
    if failures:
        print(f"{len(failures)} failed:", file=sys.stderr)
        for frame, message in failures:
            print(f"  {frame}: {message}", file=sys.stderr)
        end_unfinished(f"{len(failures)} failed in a job, listed above")


def end_unfinished(message: str, status: int = 1) -> None:
    """Exit with a status. A job of a parameter sweep raises `UnfinishedJob`, so Hydra first runs the other jobs.

    A signal, whose status is 128 or more, ends the whole sweep.
    """
    if is_sweep() and status < 128:
        raise UnfinishedJob(message)
    raise SystemExit(status)


def exit_wrong(message: object) -> None:
    """Exit after a call that was wrong."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2) from None


def exit_if_refused(error: Exception) -> None:
    """Exit after an error that is not a bug: a file that the system refused, or a pipe whose reader has ended."""
    if isinstance(error, BrokenPipeError):  # as in `cflow info | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(128 + 13) from None  # as if SIGPIPE had ended it
    if isinstance(error, OSError) and error.filename is not None:
        exit_wrong(f"{error.filename}: {error.strerror or error}; check data.root= (read) and output= (written)")
