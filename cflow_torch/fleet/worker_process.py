"""What a worker process of either engine runs: a `Worker` that does some frames at each call of its parent."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from typing import Iterator, List, Optional, Tuple

import pyarrow
import torch

from cflow_torch.fleet.job import Event, Job, Unit
from cflow_torch.fleet.progress import say
from cflow_torch.fleet.work import DeviceLost, Worker

_REPORT_EVERY_S = 0.5  # calls and answers cost a millisecond or two
_DEVICE_LOST = 70  # exit status


@dataclass(frozen=True)
class Step:
    """What happened to a unit since the last call; `ended`: nothing more follows."""

    events: Tuple[Event, ...]
    ended: bool


class WorkerProcess:
    """Lives in the worker process.

    Args:
        job: the run.
        device: where to compute.
        threads: of this process.
    """

    def __init__(self, job: Job, device: str, threads: int) -> None:
        self._job, self._device, self._threads = job, device, threads
        self._worker: Optional[Worker] = None
        self._unit: Optional[Unit] = None
        self._events: Iterator[Event] = iter(())
        self._is_told_to_stop = False

    def begin(self) -> None:
        """Make ready.

        Raises:
            CFlowError: there is no such device, or it cannot be used.
        """
        torch.set_num_threads(self._threads)
        pyarrow.set_cpu_count(self._threads)
        self._worker = Worker(self._job, self._device)

    def step(self, unit: Unit, stop: bool) -> Step:
        """Go on with a unit, or begin it, for a while.

        Args:
            unit: the same at each call until it has ended.
            stop: finish the frames in hand and begin no others.
        """
        assert self._worker is not None
        self._is_told_to_stop = stop
        if unit != self._unit:
            self._unit, self._events = unit, self._worker.run(unit, lambda: self._is_told_to_stop)
        events: List[Event] = []
        until = time.monotonic() + _REPORT_EVERY_S
        try:
            for event in self._events:
                events.append(event)
                if time.monotonic() > until:
                    return Step(tuple(events), ended=False)
        except DeviceLost as error:  # a new process may have more luck
            say(str(error))
            os._exit(_DEVICE_LOST)
        except BaseException:
            self._unit = None
            raise
        self._unit = None
        return Step(tuple(events), ended=True)
