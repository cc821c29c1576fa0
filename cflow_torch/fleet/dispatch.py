"""Engine `local`: distribute units among worker processes, and repeat the lost work of a process that dies."""

from __future__ import annotations

import time
from collections import deque
from contextlib import closing
from dataclasses import replace
from queue import Empty, Queue
from threading import Thread
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.fleet.job import Done, Event, Failed, Job, Noted, Opened, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.processes import ChildProcess, WorkerDied
from cflow_torch.fleet.progress import log_line
from cflow_torch.fleet.work import Worker, describe, make_worker, source_name
from cflow_torch.types import CFlowError

_POLL_S = 0.2  # how soon a signal is noticed
_GRACE_S = 20.0  # after a signal, time to finish the frames that have begun; schedulers kill after 30 s or more
_MAX_FAILED_STARTS = 3  # in a row; then we give up the worker
# If so many processes die on one unit, we give up the rest of it: perhaps all its frames are too large for the memory,
# and each new process takes seconds to start.
_MAX_DEATHS = 10


def run_local(
    job: Job,
    units: Sequence[Unit],
    layout: Layout,
    stop: Callable[[], bool],
    *,
    timeout: float = 600.0,
    memory: float | None = None,
) -> Iterator[Event]:
    """Do all units with processes of this machine, one per device, and yield events as they happen, see `dispatch`.

    configs/engine/local.yaml explains the settings. A single worker without a memory limit runs in this process.
    """
    if len(layout.devices) > 1 or memory is not None:
        processes = [ChildProcess(make_worker, job, device, memory, timeout=timeout) for device in layout.devices]
        yield from dispatch(processes, units, stop)
        return
    with closing(Worker(job, layout.devices[0])) as worker:
        for unit in units:
            if stop():
                break
            yield from worker.run(unit, stop)


def dispatch(
    processes: Sequence[ChildProcess], units: Sequence[Unit], stop: Callable[[], bool], retries: int = 1
) -> Iterator[Event]:
    """Do all units, and yield events as they happen. If no worker can start, that is a `CFlowError`.

    When a process dies, we repeat its unit, up to `retries` times. Then each missing frame runs by itself, with as many
    retries. This does no harm: files are written as a whole or not at all, and complete ones are skipped.

    Args:
        processes: one per worker, not started yet. A call takes a unit and yields its events. A thread of its own
            starts and calls each process; the caller's thread stops and closes it.
        units: numbered from 0.
        stop: called often. Once it returns True, frames that have begun are finished and no others begin.
    """
    processes, todo = processes[: len(units)], iter(units)
    answers: Queue[Event | Exception | None] = Queue()  # None: a unit has ended; an exception: a worker has ended
    for process in processes:
        Thread(target=_work, args=(process, todo, answers, stop, retries), daemon=True).start()
    num_units, num_workers, deadline = len(units), len(processes), float("inf")
    try:
        while num_units > 0 and time.monotonic() < deadline:
            if deadline == float("inf") and stop():
                deadline = time.monotonic() + _GRACE_S
                for process in processes:
                    process.stop()
            try:
                answer = answers.get(timeout=_POLL_S)
            except Empty:
                continue
            if answer is None:
                num_units -= 1
            elif isinstance(answer, Exception):
                num_workers -= 1
                if num_workers == 0:
                    raise CFlowError(describe(answer))
                log_line(f"{describe(answer)}; going on with {num_workers} workers")
            else:
                yield answer
    finally:
        for process in processes:
            process.close()


def _work(
    process: ChildProcess, todo: Iterator[Unit], answers: Queue[Any], stop: Callable[[], bool], retries: int
) -> None:
    """Do units until none is left. After a stop, skip the units that have not begun."""
    unit = None
    try:
        _start(process)
        for unit in todo:  # all threads share the iterator
            for event in _do(process, unit, stop, retries):
                answers.put(event)
            answers.put(None)
    except Exception as error:
        answers.put(error)
        if unit is not None:  # its missing frames are reported as not done
            answers.put(None)


def _start(process: ChildProcess) -> None:
    for _ in range(_MAX_FAILED_STARTS):
        try:
            return process.start()
        except WorkerDied as death:
            how = str(death)
    raise CFlowError(
        f"{_MAX_FAILED_STARTS} workers in a row died at their start, the last one {how}: if memory is short, give "
        "fewer engine.workers"
    )


def _do(process: ChildProcess, unit: Unit, stop: Callable[[], bool], retries: int) -> Iterator[Event]:
    """Do a unit and yield its events. When the process dies, start it again and repeat the frames that are missing."""
    name, is_opened, num_deaths = source_name(unit.source), False, 0
    pieces = deque([unit])
    while pieces and not stop():
        piece = pieces.popleft()
        missing = set(piece.only or ())  # time stamps of frames that are not settled
        try:
            for event in process.call(piece):
                if not isinstance(event, Opened):
                    if isinstance(event, (Done, Failed)):
                        missing.discard(event.timestamp)  # type: ignore[arg-type]
                    yield event
                    continue
                if is_opened:  # a repetition: the other frames were written just before the last process died
                    yield from (Done(unit.number, stamp, {}) for stamp in missing.difference(event.todo))
                else:
                    yield event
                name, is_opened, missing = event.log_id, True, set(event.todo)
            continue
        except WorkerDied as death:
            how = str(death)
        if stop():
            return
        _start(process)
        num_deaths += 1
        if num_deaths == max(_MAX_DEATHS, 2 * (retries + 1)):
            message = f"{num_deaths} workers died on this part of the log, the last one {how}: the rest is left"
            yield Failed(unit.number, name, message)
            return
        yield Noted(unit.number, name, f"a worker died {how}; another one goes on with the frames that are missing")
        stamps = sorted(missing)
        piece = replace(piece, only=frozenset(missing) if is_opened else None, deaths=piece.deaths + 1)
        if piece.deaths <= retries:
            pieces.append(piece)
        elif len(stamps) > 1:
            pieces.extend(replace(piece, only=frozenset([stamp]), deaths=0) for stamp in stamps)
        elif stamps or not is_opened:
            frame = "/".join([name, *map(str, stamps)])
            message = f"{piece.deaths} worker{'s' * (piece.deaths > 1)} died on it, the last one {how}"
            yield Failed(unit.number, frame, message, stamps[0] if stamps else None)
