"""What a worker process of engine `local` runs: a `Worker`, and how it tells what happens."""

from __future__ import annotations

import signal
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection

import pyarrow
import torch

from cflow_torch.fleet.job import Job
from cflow_torch.fleet.stop import SIGNALS
from cflow_torch.fleet.work import Worker
from cflow_torch.types import CFlowError

END = "end"  # tells a worker that there is nothing more


@dataclass(frozen=True)
class Refusal:
    """What a worker that cannot begin says."""

    message: str


@dataclass(frozen=True)
class Ready:
    """What a worker that can begin says."""


def use_threads(for_torch: int, for_pyarrow: int) -> None:
    """So many threads in this process."""
    torch.set_num_threads(for_torch)
    pyarrow.set_cpu_count(for_pyarrow)


def serve(job: Job, device: str, threads: int, pipe: Connection) -> None:
    """What a worker process runs. Signals are the parent's business: it says when to stop."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    use_threads(threads, threads)
    with suppress(ConnectionError, EOFError):  # the parent is gone: so are we
        try:
            worker = Worker(job, device)
        except CFlowError as error:
            pipe.send(Refusal(str(error)))
            return
        pipe.send(Ready())
        while True:
            unit = pipe.recv()
            if unit == END:
                break
            # While a unit is done, nothing but the end can come, or the parent's.
            for event in worker.run(unit, pipe.poll):
                pipe.send(event)
            pipe.send(None)
        worker.close()
