"""Engine `local`, and what all engines share: parts go to workers, and a part whose worker ends is tried once more."""

from __future__ import annotations

import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, wait
from contextlib import closing
from dataclasses import replace
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.fleet.executors import CannotStart, Executor, ProcessExecutor, describe
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Part
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.progress import log_line
from cflow_torch.fleet.work import Worker, make_worker, source_name
from cflow_torch.types import CFlowError

_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # after a signal, time to finish the frames that have begun; schedulers kill after 30 s or more
_MAX_LOST = 3  # processes in a row that end without an answer; then we give up the worker
_REMEDY = "if memory is short, give fewer engine.workers"
_NEVER = float("inf")


def run_local(
    job: Job,
    parts: Sequence[Part],
    layout: Layout,
    stop: Callable[[], bool],
    *,
    timeout: float = 600.0,
    memory: float | None = None,
) -> Iterator[Event]:
    """Do all parts with processes of this machine, one per device, and yield events as they happen.

    `cli.commands.Local` explains the settings. A single worker without a memory limit runs in this process.
    """
    if len(layout.devices) > 1 or memory is not None:
        executors = [ProcessExecutor(make_worker, job, device, memory) for device in layout.devices]
        yield from run_parallel(executors, parts, stop, timeout)
        return
    with closing(Worker(job, layout.devices[0])) as worker:
        for part in parts:
            if stop():
                break
            yield from worker.run(part, stop)


def run_parallel(
    executors: Sequence[Executor], parts: Sequence[Part], stop: Callable[[], bool], timeout: float = _NEVER
) -> Iterator[Event]:
    """Do all parts, and yield events as they happen. If no worker can start, that is a `CFlowError`.

    Args:
        executors: of `Worker` objects.
        parts: numbered from 0.
        stop: called often. Once it returns True, frames that have begun are finished and no others begin.
        timeout: seconds after which a worker that has not answered is replaced.
    """
    todo, end = deque(parts), _NEVER
    workers = [_Worker(executor, todo, timeout) for executor in executors]
    try:
        while time.monotonic() < end:
            is_stopped = stop()
            if is_stopped and end == _NEVER:
                end = time.monotonic() + _GRACE_S
            for worker in workers:
                if todo and worker.part is None and not is_stopped:
                    worker.begin(todo.popleft())
            answers = [worker.answer for worker in workers if worker.part is not None]
            if not answers:
                break
            wait(answers, _POLL_S, FIRST_COMPLETED)
            for worker in workers:
                yield from worker.follow(is_stopped)
            workers = _without_broken(workers)
    finally:
        for executor in executors:
            executor.close()


class _Worker:
    """A `Worker` in an executor, and the part that it does."""

    def __init__(self, executor: Executor, todo: deque[Part], timeout: float) -> None:
        self.executor, self.todo, self.timeout = executor, todo, timeout
        self.part: Part | None = None
        self.answer: Future[Any] = Future()
        self.problem = ""  # why it is given up
        self._deadline = _NEVER
        self._num_lost = 0  # processes since the last answer
        self._name = ""  # of the log
        self._missing: set[int] | None = None  # time stamps of frames without a result; None = the part is not open

    def begin(self, part: Part) -> None:
        self.part, self._missing = part, None
        self._name = source_name(part.source)
        self._ask(part, False)

    def _ask(self, part: Part | None, is_stopped: bool) -> None:
        self.answer = self.executor.submit("next_event", part, is_stopped)
        self._deadline = time.monotonic() + self.timeout

    def follow(self, is_stopped: bool) -> Iterator[Event]:
        """Yield the event that the worker has answered, if it has, and ask for the next one."""
        part, is_late = self.part, time.monotonic() > self._deadline
        if part is None or not (self.answer.done() or is_late):
            return
        error = self.answer.exception() if self.answer.done() else BrokenExecutor(f"no answer for {self.timeout:g} s")
        if isinstance(error, CannotStart):
            self.part, self.problem = None, str(error)
            self.todo.appendleft(part)
        elif error is not None:
            how = describe(error)
            self.executor.close()
            self.part, self._num_lost = None, self._num_lost + 1
            if self._num_lost == _MAX_LOST:
                self.problem = f"{_MAX_LOST} workers died before they began, the last one: {how}: {_REMEDY}"
            yield from self._try_again(part, how)
        elif self.answer.result() is None:
            self.part = None
        else:
            yield from self._pass_on(part, self.answer.result())
            self._num_lost = 0
            self._ask(None, is_stopped)

    def _pass_on(self, part: Part, event: Event) -> Iterator[Event]:
        if isinstance(event, Opened):
            self._name, self._missing = event.log_id, set(event.todo)
            if part.only is None:
                yield event
            elif not event.todo:  # its file was written just before the first worker died
                yield Done(part.number, part.only, {})
            return
        if isinstance(event, (Done, Failed)) and self._missing is not None:
            self._missing.discard(event.timestamp)  # type: ignore[arg-type]
        yield event

    def _try_again(self, part: Part, how: str) -> Iterator[Event]:
        """Try each missing frame by itself. A frame, or a log that did not open, is tried once more, then reported."""
        if part.only is None and self._missing is not None:
            self.todo.extend(replace(part, only=stamp, attempt=1) for stamp in sorted(self._missing))
        elif part.attempt == 1:
            self.todo.append(replace(part, attempt=2))
        else:
            name = self._name if part.only is None else f"{self._name}/{part.only}"
            yield Failed(part.number, name, f"2 workers died on it, the last one: {how}", part.only)
            return
        yield Noted(part.number, self._name, f"a worker died ({how}): its frames are tried again, one by one")


def _without_broken(workers: Sequence[_Worker]) -> list[_Worker]:
    """Leave out the workers that have a problem, and print it. If no other is left, it is a `CFlowError`."""
    left = [worker for worker in workers if not worker.problem]
    for worker in workers:
        if worker.problem and not left:
            raise CFlowError(worker.problem)
        if worker.problem:
            log_line(f"{worker.problem}; going on with {len(left)} workers")
    return left
