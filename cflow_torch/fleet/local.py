"""Engine `local`: worker processes of this machine."""

from __future__ import annotations

import multiprocessing
import signal
from concurrent.futures import Future, TimeoutError
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Callable, Iterator, Sequence

from pebble import ProcessExpired, ProcessPool

from cflow_torch.fleet.dispatch import SIGNALS, WorkerDied, dispatch
from cflow_torch.fleet.job import Event, Job, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.work import Worker, describe
from cflow_torch.fleet.worker_process import Step, WorkerProcess
from cflow_torch.types import CFlowError

_RETRIES = 1


def run_local(
    job: Job,
    units: Sequence[Unit],
    layout: Layout,
    stop: Callable[[], bool],
    *,
    timeout: float = 600.0,
    memory: float | None = None,
) -> Iterator[Event]:
    """Do all units.

    Args:
        job: the run.
        units: numbered as in `split`.
        layout: one worker per device. A single worker without a limit of memory is this very process.
        stop: asked all the time; from True on, frames in hand are finished and no others begun.
        timeout: seconds after which a worker process that has given no sign is replaced.
        memory: bytes of address space that each worker process may take, of which Python and torch need some 3e9;
            None = no limit. For a CPU: the driver of a GPU reserves far more than it uses.

    Raises:
        CFlowError: no worker can begin; a setting out of range.

    Yields:
        What happens, as it happens. A worker that dies or is killed is replaced, and its unit done again, see
        `dispatch`; a frame that kills its workers even by itself is `Failed`.
    """
    for name, value in (("timeout", timeout), ("memory", 1 if memory is None else memory)):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise CFlowError(f"engine.{name}={value!r}: give a number above 0")
    if len(layout.devices) == 1 and memory is None:
        yield from _run_here(job, units, layout, stop)
    elif units:
        handles = [_Process((job, device, memory), timeout) for device in layout.devices]
        yield from dispatch(handles, units, stop, _RETRIES)


def _run_here(job: Job, units: Sequence[Unit], layout: Layout, stop: Callable[[], bool]) -> Iterator[Event]:
    worker = Worker(job, layout.devices[0])
    try:
        for unit in units:
            if stop():
                break
            yield from worker.run(unit, stop)
    finally:
        worker.close()


class _Process:
    """A `Handle`: a pool of one process, so that a worker keeps its log, and shares no pipe that it may break.

    Args:
        arguments: of `_begin`.
        timeout: seconds that a call may take.
    """

    def __init__(self, arguments: Sequence[Any], timeout: float) -> None:
        self._arguments, self._timeout = arguments, timeout
        self._pool: ProcessPool | None = None

    def begin(self) -> Future:
        if self._pool is None:
            context = multiprocessing.get_context("spawn")  # fork and threads, or CUDA, do not go together
            self._pool = ProcessPool(1, context=context)
        return self._call(_begin, *self._arguments)

    def step(self, unit: Unit, stop: bool) -> Future:
        return self._call(_step, unit, stop)

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Future:
        assert self._pool is not None
        try:
            return self._pool.schedule(function, arguments, timeout=self._timeout)
        except RuntimeError as error:  # it died between two calls, or could not be started
            call: Future = Future()
            call.set_exception(BrokenProcessPool(describe(error.__cause__ or error)))
            return call

    def result(self, call: Future) -> Any:
        error = call.exception()
        if isinstance(error, ProcessExpired):
            raise WorkerDied(_how(error.exitcode))
        if isinstance(error, TimeoutError):
            raise WorkerDied(f"after {self._timeout:g} s without a sign")
        if isinstance(error, BrokenProcessPool):
            self.close()
            raise WorkerDied(f"({error})")
        return call.result()

    def close(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()
            pool.join()


_process: WorkerProcess  # of a worker process


def _begin(job: Job, device: str, memory: float | None) -> None:
    """A worker process begins. Signals are the business of the parent, which says when to stop."""
    global _process
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if memory is not None:
        import resource  # not on every system

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    _process = WorkerProcess(job, device)


def _step(unit: Unit, stop: bool) -> Step:
    return _process.step(unit, stop)


def _how(status: int | None) -> str:
    """A worker died."""
    if status is None or status >= 0:
        return f"with status {status}"
    return f"by signal {-status}, {signal.strsignal(-status)}" + " (out of memory?)" * (-status == signal.SIGKILL)
