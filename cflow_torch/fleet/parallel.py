"""Run the parts of logs on executors. A part whose worker ends is tried once more, frame by frame, then reported."""

from __future__ import annotations

import math
import time
from collections import deque
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Callable, Generator, Iterator, Sequence

from cflow_torch.fleet.executors import CannotStart, Executor, InlineExecutor, ProcessExecutor, describe_error
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Part
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.work import Worker, make_worker, source_name

Events = Generator[Event, None, None]
_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # after a signal, time to finish the frames that have begun; schedulers kill after 30 s or more
_REMEDY = "if memory is short, give fewer engine.workers"


@contextmanager
def local_executors(
    job: Job, layout: Layout, timeout: float = 600.0, memory: float | None = None
) -> Iterator[list[Executor]]:
    """Engine `local`: a process of this machine per device; `cli.commands.Local` explains the settings.

    A single worker without a memory limit runs in this process.
    """
    if len(layout.devices) == 1 and memory is None:
        yield [InlineExecutor(partial(Worker, job, layout.devices[0]))]
    else:
        yield [ProcessExecutor(partial(make_worker, job, device, memory), timeout) for device in layout.devices]


def run_parallel(executors: Sequence[Executor], parts: Sequence[Part], stop: Callable[[], bool]) -> Events:
    """Do all parts, and yield events as they happen. A worker that cannot start is a `CFlowError`.

    Args:
        executors: of `Worker` objects.
        parts: numbered from 0.
        stop: called often. Once it returns True, frames that have begun are finished and no others begin.
    """
    todo = deque(parts)
    idle = list(executors)
    tasks: list[_Task] = []
    end = math.inf
    try:
        while time.monotonic() < end:
            is_stopped = stop()
            if is_stopped:
                end = min(end, time.monotonic() + _GRACE_S)
            while todo and idle and not is_stopped:
                tasks.append(_Task(idle.pop(), todo.popleft()))
            if not tasks:
                break
            wait([task.answer for task in tasks], _POLL_S, FIRST_COMPLETED)
            for task in tasks:
                yield from task.follow(is_stopped, todo)
            idle += [task.executor for task in tasks if task.is_done]
            tasks = [task for task in tasks if not task.is_done]
    finally:
        for executor in executors:
            executor.close()


class _Task:
    """A part of a log that a `Worker` in an executor does."""

    def __init__(self, executor: Executor, part: Part) -> None:
        self.executor = executor
        self.is_done = False
        self._part = part
        self._name = source_name(part.source)  # of the log
        self._missing: set[int] | None = None  # time stamps of frames without a result; None = the log is not open
        self._ask(part, False)

    def _ask(self, part: Part | None, is_stopped: bool) -> None:
        self.answer = self.executor.submit("next_event", part, is_stopped)
        self._deadline = time.monotonic() + self.executor.timeout

    def follow(self, is_stopped: bool, todo: deque[Part]) -> Iterator[Event]:
        """Yield the event that the worker has answered, if it has, and ask for the next one."""
        is_late = time.monotonic() > self._deadline
        if not (self.answer.done() or is_late):
            return
        silence = BrokenExecutor(f"no answer for {self.executor.timeout:g} s")
        error = self.answer.exception() if self.answer.done() else silence
        if isinstance(error, CannotStart):
            raise error
        if error is not None:
            ending = self.executor.close()
            self.is_done = True
            yield from self._try_again(todo, ending if isinstance(error, BrokenProcessPool) else describe_error(error))
            return
        event: Event | None = self.answer.result()
        if event is None:
            self.is_done = True
            return
        yield from self._pass_on(event)
        self._ask(None, is_stopped)

    def _pass_on(self, event: Event) -> Iterator[Event]:
        if isinstance(event, Opened):
            self._name = event.log_id
            self._missing = set(event.todo)
            if self._part.only is None:
                yield event
            elif not event.todo:  # its file was written just before the first worker died
                yield Done(self._part.number, self._part.only, {})
            return
        if isinstance(event, (Done, Failed)) and self._missing is not None:
            self._missing.discard(event.timestamp)  # type: ignore[arg-type]
        yield event

    def _try_again(self, todo: deque[Part], how: str) -> Iterator[Event]:
        """Try each frame that has no result once more, alone, or the log if it did not open; then report it."""
        part = self._part
        if part.is_retry:
            name = self._name if part.only is None else f"{self._name}/{part.only}"
            yield Failed(part.number, name, f"its worker died again ({how}): {_REMEDY}", part.only)
            return
        if self._missing is None:
            todo.append(replace(part, is_retry=True))
        else:
            todo.extend(replace(part, only=stamp, is_retry=True) for stamp in sorted(self._missing))
        yield Noted(part.number, self._name, f"a worker died ({how}): its frames are tried again, one by one")
