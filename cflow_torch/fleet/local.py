"""Engine `local`: worker processes of this machine."""

from __future__ import annotations

from typing import Callable, Iterator, Sequence

from cflow_torch.fleet.dispatch import dispatch
from cflow_torch.fleet.job import Event, Job, Step, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.processes import ChildProcess
from cflow_torch.fleet.work import Worker, WorkerProcess
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
        layout: one worker per device. A single worker without a memory limit runs in this process.
        stop: called often. Once it returns True, frames in hand are finished and no others begin.
        timeout: seconds after which a worker process that has not answered is replaced.
        memory: bytes of address space that each worker process may use, of which Python and torch need about 3e9;
            None = no limit. Use it on a CPU only: the driver of a GPU reserves far more than it uses.

    Raises:
        CFlowError: no worker can start, or a setting is out of range.

    Yields:
        Events as they happen. A worker that dies is replaced and its unit is repeated, see `dispatch`.
    """
    for name, value in (("timeout", timeout), ("memory", 1 if memory is None else memory)):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise CFlowError(f"engine.{name}={value!r}: give a number above 0")
    if len(layout.devices) == 1 and memory is None:
        yield from _run_here(job, units, layout, stop)
    elif units:
        processes = [ChildProcess(_make_worker, job, device, memory, timeout=timeout) for device in layout.devices]
        yield from dispatch(processes, units, stop, _RETRIES)


def _run_here(job: Job, units: Sequence[Unit], layout: Layout, stop: Callable[[], bool]) -> Iterator[Event]:
    worker = Worker(job, layout.devices[0])
    try:
        for unit in units:
            if stop():
                break
            yield from worker.run(unit, stop)
    finally:
        worker.close()


def _make_worker(job: Job, device: str, memory: float | None) -> Callable[[Unit, bool], Step]:
    if memory is not None:
        import resource  # not available on Windows

        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    return WorkerProcess(job, device).step
