"""What a worker process of either engine runs: a `Worker` that does some frames at each call of its parent."""

from __future__ import annotations

import os
import time
from typing import Iterator, NamedTuple

import pyarrow
import torch

from cflow_torch.fleet.job import Event, Job, Opened, Unit
from cflow_torch.fleet.progress import log_line
from cflow_torch.fleet.work import DeviceLost, Worker, describe

_REPORT_EVERY_S = 0.5  # a call and its answer cost a millisecond or two
_ENDED = 70  # exit status


class Step(NamedTuple):
    """What happened to a unit since the last call; `has_ended`: nothing more follows."""

    events: list[Event]
    has_ended: bool


class WorkerProcess(Worker):
    """A worker that lives in a process of its own.

    Args:
        job: the run.
        device: where to compute.

    Raises:
        CFlowError: there is no such device, or it cannot be used.
    """

    def __init__(self, job: Job, device: str) -> None:
        if device == "cpu":  # the other cores have workers of their own
            torch.set_num_threads(1)
            pyarrow.set_cpu_count(1)
        super().__init__(job, device)
        self._events: Iterator[Event] | None = None  # of the unit in hand
        self._is_told_to_stop = False

    def step(self, unit: Unit, stop: bool) -> Step:
        """Continue a unit for a while, or begin it.

        Args:
            unit: the same at each call until it has ended.
            stop: finish the frames in hand and begin no others.
        """
        self._is_told_to_stop = stop
        running, self._events = self._events or self.run(unit, lambda: self._is_told_to_stop), None
        events: list[Event] = []
        until = time.monotonic() + _REPORT_EVERY_S
        try:
            for event in running:
                events.append(event)
                # The parent must know the frames of a unit, should one of them be deadly.
                if isinstance(event, Opened) or time.monotonic() > until:
                    self._events = running
                    return Step(events, has_ended=False)
        except (DeviceLost, SystemExit) as error:  # a new process may have more luck
            log_line(f"a worker ends: {describe(error)}")
            os._exit(_ENDED)
        return Step(events, has_ended=True)
