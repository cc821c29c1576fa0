"""Run the parts of logs on executors. A part whose worker ends is tried once more, frame by frame, then reported."""

from __future__ import annotations

import math
import time
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from queue import Empty, SimpleQueue
from threading import Event as Flag
from threading import Thread
from typing import Any, Callable, Generator, Iterator, Sequence

from cflow_torch.data.catalog import source_name
from cflow_torch.errors import CFlowError
from cflow_torch.fleet.executors import Executor, InlineExecutor, ProcessExecutor
from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Part
from cflow_torch.fleet.work import Worker, make_worker

Events = Generator[Event, None, None]
_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # after a signal, time to finish the frames that have begun; schedulers kill after 30 s or more
_REMEDY = "give fewer engine.workers if memory is short, or a larger engine.timeout if a batch takes longer"


@contextmanager
def local_executors(
    job: Job, devices: Sequence[str], timeout: float = 600.0, memory: float | None = None
) -> Iterator[list[Executor]]:
    """Engine `local`: a process of this machine per device; `cli.commands.Local` explains the settings.

    A single worker without a memory limit runs in this process.
    """
    if memory is not None and (not find_spec("resource") or devices[0] != "cpu"):
        raise CFlowError("engine.memory is for workers on a CPU, and not for Windows: leave it out")
    if len(devices) == 1 and memory is None:
        yield [InlineExecutor(partial(Worker, job, devices[0]))]
    else:
        limits = {"next_event": timeout}
        yield [ProcessExecutor(partial(make_worker, job, device, memory), limits) for device in devices]


def run_parallel(executors: Sequence[Executor], parts: Sequence[Part], stop: Callable[[], bool]) -> Events:
    """Do all parts, and yield events as they happen. A worker that cannot start is a `CFlowError`.

    A thread waits for each executor, unless its object is in this process.

    Args:
        executors: of `Worker` objects.
        parts: of logs.
        stop: called often. Once it returns True, frames that have begun are finished and no others begin.
    """
    todo: SimpleQueue[Part] = SimpleQueue()
    for part in parts:
        todo.put(part)
    is_over = Flag()
    try:
        if len(executors) == 1 and isinstance(executors[0], InlineExecutor):
            yield from _do_all(executors[0], todo, stop)
        else:
            yield from _merged([_do_all(e, todo, lambda: is_over.is_set() or stop()) for e in executors], stop)
    finally:
        is_over.set()
        for executor in executors:
            executor.close()


def _merged(sources: Sequence[Iterator[Event]], stop: Callable[[], bool]) -> Iterator[Event]:
    """Yield events of several iterators, each in a thread of its own. After a stop, we do not wait for hanging ones."""
    events: SimpleQueue[Any] = SimpleQueue()  # an error ends the run; None = an iterator has ended

    def pass_on(source: Iterator[Event]) -> None:
        try:
            for event in source:
                events.put(event)
            events.put(None)
        except BaseException as error:
            events.put(error)

    for source in sources:
        Thread(target=pass_on, args=(source,), daemon=True).start()
    num_left = len(sources)
    end = math.inf
    while num_left > 0 and time.monotonic() < end:
        if stop():
            end = min(end, time.monotonic() + _GRACE_S)
        with suppress(Empty):
            event = events.get(timeout=_POLL_S)
            if isinstance(event, BaseException):
                raise event
            if event is None:
                num_left = num_left - 1
            else:
                yield event


def _do_all(executor: Executor, todo: SimpleQueue[Part], stop: Callable[[], bool]) -> Iterator[Event]:
    with suppress(Empty):
        while not stop():
            yield from _do(executor, todo.get_nowait(), stop)


def _do(executor: Executor, part: Part, stop: Callable[[], bool], is_again: bool = False) -> Iterator[Event]:
    """Do a part. If its worker dies, try each frame that has no result once more, alone, then report it.

    If the log did not open, we try the part once more.
    """
    name = source_name(part.source)
    left = {part.only or name}
    try:
        for event in _events(executor, part, stop, left):
            if part.only is None or not isinstance(event, Opened):
                yield event
            elif not event.todo:  # its file was written just before the first worker died
                yield Done(part.only, {})
        return
    except BrokenExecutor as error:
        death = str(error)
    if stop():
        return
    is_open = left != {name}
    if is_again and (part.only is not None or not is_open):
        for lost in sorted(left):
            yield Failed(lost, f"its worker died again ({death}): {_REMEDY}")
        return
    yield Noted(name, f"a worker died ({death}): its frames are tried again, one by one")
    for again in [replace(part, only=frame) for frame in sorted(left)] if is_open else [part]:
        if not stop():
            yield from _do(executor, again, stop, is_again=True)


def _events(executor: Executor, part: Part, stop: Callable[[], bool], left: set[str]) -> Iterator[Event]:
    """Yield the events of a part. `left` has the names of what has no result: the log until it is open, then frames."""
    event = executor.call("begin", part, stop())
    while event is not None:
        if isinstance(event, Opened):
            left.clear()
            left.update(event.todo)
        elif not isinstance(event, Noted):
            left.discard(event.name)
        yield event
        event = executor.call("next_event", stop())
