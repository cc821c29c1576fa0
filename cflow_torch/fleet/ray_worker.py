"""What engine `ray` runs in its actors: a `Worker`, and how it tells what happens."""

from __future__ import annotations

import os
import pickle
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Iterator, List, Optional, Tuple

import numpy as np
import pyarrow as pa
import torch

from cflow_torch import __version__
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.job import Begun, Event, Job, Opened, Unit
from cflow_torch.fleet.manifest import MANIFEST
from cflow_torch.fleet.work import Worker, describe
from cflow_torch.types import CFlowError

ASK_S = 0.5  # how often a worker asks whether to stop


@dataclass(frozen=True)
class News:
    """A row of the result: what happened to a unit since the last one.

    Args:
        unit: its number.
        events: in order.
        ended: nothing more follows.
        refusal: why the worker cannot begin at all.
    """

    unit: int
    events: Tuple[Event, ...] = ()
    ended: bool = False
    refusal: Optional[str] = None


class RayWorker:
    """Makes its `Worker` with its first unit.

    Args:
        job: the run.
        device: where to compute.
        threads: of this worker.
        flag: says when to stop.
        must_look: whether this machine sees the output.
    """

    def __init__(self, job: Job, device: str, threads: int, flag: Any, must_look: bool) -> None:
        self._job, self._device, self._threads, self._flag, self._must_look = job, device, threads, flag, must_look
        self._versions, self._folder = _versions(), os.getcwd()  # of the driver
        self._worker: Optional[Worker] = None

    def __call__(self, batch: pa.Table) -> Iterator[pa.Table]:
        """Units to news of them, each at once."""
        for unit in map(pickle.loads, batch["unit"].to_pylist()):
            for news in self._run(unit):
                yield pa.table({"news": [pickle.dumps(news)]})

    def _run(self, unit: Unit) -> Iterator[News]:
        stop = _Asker(self._flag)
        if stop():
            return
        yield News(unit.number)
        try:
            worker = self._worker = self._worker or self._make()
        except Exception as error:
            yield News(unit.number, refusal=describe(error))
            return
        events: List[Event] = []
        for event in worker.run(unit, stop):
            events.append(event)
            if isinstance(event, (Opened, Begun)):  # must be known before the frames are touched; others can wait
                yield News(unit.number, tuple(events))
                events.clear()
        yield News(unit.number, tuple(events), ended=True)

    def _make(self) -> Worker:
        import ray

        node = ray.util.get_node_ip_address()
        if self._versions != _versions():
            raise CFlowError(f"node {node} has {_versions()}, where this run began there are {self._versions}")
        if self._must_look and not (as_path(self._job.output) / MANIFEST).exists():
            raise CFlowError(f"node {node} does not see {self._job.output}: the output must be reachable everywhere")
        with suppress(OSError):  # relative names of data mean the same as in the driver
            os.chdir(self._folder)
        torch.set_num_threads(self._threads)
        pa.set_cpu_count(self._threads)
        return self._new_worker()

    def _new_worker(self) -> Worker:
        return Worker(self._job, self._device)


class _Asker:
    """Asks a flag now and then."""

    def __init__(self, flag: Any) -> None:
        self._flag, self._is_set, self._next = flag, False, 0.0

    def __call__(self) -> bool:
        if not self._is_set and time.monotonic() >= self._next:
            self._is_set, self._next = self._flag.is_set(), time.monotonic() + ASK_S
        return self._is_set


def _versions() -> str:
    """What a result depends on."""
    python = ".".join(map(str, sys.version_info[:2]))
    torch_version = str(torch.__version__).split("+")[0]
    return f"cflow_torch {__version__}, torch {torch_version}, numpy {np.__version__}, Python {python}"
