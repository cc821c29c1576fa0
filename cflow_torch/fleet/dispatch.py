"""Hands out units to worker processes, gathers what happens, and has done again what was lost with a worker."""

from __future__ import annotations

import signal
import time
from collections import Counter, deque
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any, Callable, Iterator, Protocol, Sequence

from cflow_torch.fleet.job import Event, Failed, Opened, Unit
from cflow_torch.fleet.progress import log_line
from cflow_torch.fleet.work import describe, source_name
from cflow_torch.types import CFlowError

SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]  # end a run
_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # that workers have for the frames in hand after a signal; schedulers kill after 30 s and more
_MOST_FAILED_STARTS = 3  # workers that died one after the other before they could begin: so would all others
# Workers that may die on one unit; then the rest of it is left. All its frames may be too large for the memory, and a
# new worker takes seconds to start.
_MOST_OF_UNIT = 10


class WorkerDied(Exception):
    """A worker process is gone; the text says how, "by SIGKILL"."""


class Handle(Protocol):
    """A worker process as its engine sees it. Another process takes its place when it dies."""

    def begin(self) -> Future:
        """Make a `WorkerProcess`, in a new process if there is none."""

    def step(self, unit: Unit, stop: bool) -> Future:
        """Call its `step`."""

    def result(self, call: Future) -> Any:
        """What a call gave, or raises what it raised; `WorkerDied` if the process is gone."""

    def close(self) -> None:
        """End the process, whatever it does."""


class _Worker:
    """A worker and what it has in hand."""

    def __init__(self, handle: Handle) -> None:
        self.handle = handle
        self.is_ready = False
        self.unit: Unit | None = None
        self.opened: Opened | None = None
        self.left: set[int] = set()  # time stamps of the unit's frames that are not settled, once it is opened
        self.call: Future | None = None

    def take(self, unit: Unit | None) -> None:
        """Have a unit in hand, or none."""
        self.unit, self.opened, self.left = unit, None, set()

    def follow(self, event: Event) -> None:
        """Something happened to the unit."""
        if isinstance(event, Opened):
            self.opened, self.left = event, set(event.todo)
        elif event.timestamp is not None:
            self.left.discard(event.timestamp)


def dispatch(
    handles: Sequence[Handle], units: Sequence[Unit], stop: Callable[[], bool], retries: int
) -> Iterator[Event]:
    """Do all units.

    When a worker dies, its unit is done again, then each frame of it by itself. Frames are written whole or not at all,
    so that this does no harm; what is complete is skipped.

    Args:
        handles: the workers, not started yet.
        units: numbered as in `split`.
        stop: asked all the time; from True on, frames in hand are finished and no others begun.
        retries: how often a unit is done again, and then each of its frames by itself.

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
        self._queue: deque[Unit] = deque(units)
        self._stop, self._retries = stop, retries
        self._failed_starts = 0  # in a row
        self._deaths: Counter[int] = Counter()  # unit number -> workers that died on it or its frames

    def events(self) -> Iterator[Event]:
        """See `dispatch`."""
        told: float | None = None
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
            worker.take(self._queue.popleft())
        if worker.unit is not None:
            worker.call = worker.handle.step(worker.unit, self._stop())
        elif not worker.is_ready and self._queue:
            worker.call = worker.handle.begin()

    def _hear(self, worker: _Worker, call: Future) -> Iterator[Event]:
        """The answer to a call."""
        unit = worker.unit
        try:
            step = worker.handle.result(call)
        except WorkerDied as death:
            worker.is_ready = False
            if unit is not None:
                yield from self._on_death(worker, unit, str(death))
            else:
                self._on_failed_start(worker, str(death))
        except Exception as error:
            worker.take(None)
            if unit is None:  # its GPU is gone, say: the others do its work
                self._leave_out(worker, describe(error))
            else:
                yield Failed(unit.number, source_name(unit.source), describe(error))
        else:
            self._failed_starts, worker.is_ready = 0, True
            for event in step.events if step else []:
                worker.follow(event)
                yield event
            if step and step.has_ended:
                worker.take(None)

    def _on_failed_start(self, worker: _Worker, how: str) -> None:
        """A worker died before it could begin."""
        self._failed_starts += 1
        if self._failed_starts >= _MOST_FAILED_STARTS:
            self._leave_out(
                worker,
                f"{self._failed_starts} workers one after the other died before they could begin, the last one {how} "
                "(give fewer engine.workers if it is the memory, else see above)",
            )

    def _on_death(self, worker: _Worker, unit: Unit, how: str) -> Iterator[Failed]:
        """A worker died on a unit: what is left of it is to be done again, or given up."""
        opened = worker.opened
        left = frozenset(worker.left) if opened else unit.only  # None: nobody knows
        worker.take(None)
        number, most = unit.number, max(_MOST_OF_UNIT, 2 * (self._retries + 1))
        if self._deaths[number] >= most or (opened and not left):
            return
        self._deaths[number] += 1
        name = opened.log_id if opened else source_name(unit.source)
        if self._deaths[number] >= most:
            self._queue = deque(unit for unit in self._queue if unit.number != number)
            message = f"{most} workers died on this part of the log, the last one {how}: the rest of it is left"
            yield Failed(number, name, message)
            return
        stamp = min(left) if left and len(left) == 1 else None
        before = 0 if stamp is not None and unit.only != left else unit.deaths  # the others may be to blame
        unit = replace(unit, only=left, deaths=before + 1)
        if unit.deaths > self._retries and (stamp is not None or not left):
            many = f"{unit.deaths} worker{'s' * (unit.deaths > 1)}"
            frame = name if stamp is None else f"{name}/{stamp}"
            yield Failed(number, frame, f"{many} died on it, the last one {how}", stamp)
        elif not self._stop():
            alone = [replace(unit, only=frozenset([stamp]), deaths=0) for stamp in sorted(left or [])]
            self._queue.extend([unit] if unit.deaths <= self._retries else alone)

    def _leave_out(self, worker: _Worker, why: str) -> None:
        self._workers.remove(worker)
        if not self._workers:
            raise CFlowError(why)
        log_line(f"{why}; going on with {len(self._workers)} workers")
