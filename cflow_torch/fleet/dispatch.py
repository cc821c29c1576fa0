"""Hands out units to worker processes, gathers what happens, and has done again what was lost with a worker."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from typing import Any, Callable, Deque, Iterator, Optional, Protocol, Sequence

from cflow_torch.fleet.job import Event, Failed, Unit
from cflow_torch.fleet.progress import say
from cflow_torch.fleet.retries import Retries
from cflow_torch.fleet.work import describe, source_name
from cflow_torch.types import CFlowError

_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # that workers have for the frames in hand after a signal; schedulers kill after 30 s and more
_MOST_FAILED_STARTS = 3  # workers that died one after the other before they could begin: so would all others


class WorkerDied(Exception):
    """A worker process is gone; the text says how, "by SIGKILL"."""


class Handle(Protocol):
    """A worker process as its engine sees it. Another process takes its place when it dies."""

    def begin(self) -> Future:
        """Call `WorkerProcess.begin`, in a new process if there is none."""

    def step(self, unit: Unit, stop: bool) -> Future:
        """Call `WorkerProcess.step`."""

    def result(self, call: Future) -> Any:
        """What a call gave, or raises what it raised; `WorkerDied` if the process is gone."""

    def close(self) -> None:
        """End the process, whatever it does."""


class _Worker:
    """A worker and what it has in hand."""

    def __init__(self, handle: Handle) -> None:
        self.handle = handle
        self.is_ready = False
        self.unit: Optional[Unit] = None
        self.call: Optional[Future] = None


def dispatch(
    handles: Sequence[Handle], units: Sequence[Unit], stop: Callable[[], bool], retries: int
) -> Iterator[Event]:
    """Do all units.

    Args:
        handles: the workers, not started yet.
        units: numbered as in `split`.
        stop: asked all the time; from True on, frames in hand are finished and no others begun.
        retries: see `Retries`.

    Yields:
        What happens, as it happens.

    Raises:
        CFlowError: no worker can begin.
    """
    handles = handles[: len(units)]
    try:
        yield from _Run(handles, units, stop, retries).events()
    finally:
        with ThreadPoolExecutor(len(handles)) as closing:  # a process that hangs takes seconds
            list(closing.map(lambda handle: handle.close(), handles))


class _Run:
    def __init__(
        self, handles: Sequence[Handle], units: Sequence[Unit], stop: Callable[[], bool], retries: int
    ) -> None:
        self._workers = [_Worker(handle) for handle in handles]
        self._queue: Deque[Unit] = deque(units)
        self._stop, self._retries = stop, Retries(retries)
        self._failed_starts = 0  # in a row

    def events(self) -> Iterator[Event]:
        """See `dispatch`."""
        told: Optional[float] = None
        while True:
            if self._stop() and told is None:
                told = time.monotonic()
                self._queue.clear()
            for worker in self._workers:
                if worker.call is None:
                    self._give_work(worker)
            is_over = told is not None and time.monotonic() - told > _GRACE_S
            if is_over or not (self._queue or any(worker.unit for worker in self._workers)):
                return
            calls = {worker.call: worker for worker in self._workers if worker.call is not None}
            for call in wait(calls, timeout=_POLL_S, return_when=FIRST_COMPLETED).done:
                calls[call].call = None
                yield from self._hear(calls[call], call)

    def _give_work(self, worker: _Worker) -> None:
        if worker.is_ready and worker.unit is None and self._queue:
            worker.unit = self._queue.popleft()
        if worker.unit is not None:
            worker.call = worker.handle.step(worker.unit, self._stop())
        elif not worker.is_ready and self._queue:
            worker.call = worker.handle.begin()

    def _hear(self, worker: _Worker, call: Future) -> Iterator[Event]:
        """The answer to a call."""
        try:
            step = worker.handle.result(call)
        except WorkerDied as death:
            yield from self._on_exit(worker, str(death))
        except Exception as error:
            unit, worker.unit = worker.unit, None
            if unit is None:  # its GPU is gone, say: the others do its work
                self._leave_out(worker, describe(error))
            else:
                yield Failed(unit.number, source_name(unit.source), describe(error))
        else:
            self._failed_starts, worker.is_ready = 0, True
            for event in step.events if step else []:
                self._retries.follow(event)
                yield event
            if step and step.has_ended:
                worker.unit = None

    def _on_exit(self, worker: _Worker, how: str) -> Iterator[Event]:
        """A worker died: another process has to begin, and what it had in hand is to be done again."""
        if not worker.is_ready:
            self._failed_starts += 1
            if self._failed_starts >= _MOST_FAILED_STARTS:
                self._leave_out(
                    worker,
                    f"{self._failed_starts} workers one after the other died before they could begin, the last one "
                    f"{how} (give fewer engine.workers if it is the memory, else see above)",
                )
        unit, worker.unit, worker.is_ready = worker.unit, None, False
        if unit is not None:
            failed, again = self._retries.on_failure(unit, f"the last one {how}")
            for event in failed:
                self._retries.follow(event)
                yield event
            if not self._stop():
                left = [unit for unit in self._queue if not self._retries.is_given_up(unit)]
                self._queue = deque(left + again)

    def _leave_out(self, worker: _Worker, why: str) -> None:
        self._workers.remove(worker)
        if not self._workers:
            raise CFlowError(why)
        say(f"{why}; going on with {len(self._workers)} workers")
