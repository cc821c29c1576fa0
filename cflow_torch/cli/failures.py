"""What fails in a run: it is reported, the rest goes on, and the exit status tells."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from typing import Iterator, List, Tuple

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from cflow_torch.cli.exits import UnfinishedJob
from cflow_torch.errors import CFlowError
from cflow_torch.fleet.progress import log_line

Failures = List[Tuple[str, str]]  # name of a frame or log, and message


def is_sweep() -> bool:
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
    """Print the failures, and exit with status 1 if there are any.

    A job of a parameter sweep raises `UnfinishedJob`, so that Hydra runs the other jobs before it exits with status 1.
    """
    if failures:
        print(f"{len(failures)} failed:", file=sys.stderr)
        for frame, message in failures:
            print(f"  {frame}: {message}", file=sys.stderr)
        if is_sweep():
            raise UnfinishedJob(f"{len(failures)} failed in a job, listed above")
        raise SystemExit(1)
