"""A whole run: start the engine, count its events, react to signals, write the report."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import closing, suppress
from typing import Any, Callable, Iterator, Sequence

from cflow_torch.data.atomic import remove_stale
from cflow_torch.data.files import write_json
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.dispatch import dispatch
from cflow_torch.fleet.job import Event, Failed, Job, Noted, Shard, Unit
from cflow_torch.fleet.machine import Layout
from cflow_torch.fleet.processes import SIGNALS, ChildProcess
from cflow_torch.fleet.progress import Progress, log_line
from cflow_torch.fleet.ray_engine import run_ray
from cflow_torch.fleet.report import Counters
from cflow_torch.fleet.work import Worker, make_worker
from cflow_torch.types import CFlowError

_SHOWN = 3  # how often a message is shown; the report names all logs that it is about
_RETRIES = 1  # of a unit after a worker process died on it


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

    A single worker without a memory limit runs in this process.

    Args:
        timeout: seconds after which a worker process that has not answered is replaced.
        memory: bytes of address space that each worker process may use, of which Python and torch need about 3e9;
            None = no limit. Use it on a CPU only: the driver of a GPU reserves far more than it uses.
    """
    if len(layout.devices) > 1 or memory is not None:
        processes = [ChildProcess(make_worker, job, device, memory, timeout=timeout) for device in layout.devices]
        yield from dispatch(processes, units, stop, _RETRIES)
        return
    with closing(Worker(job, layout.devices[0])) as worker:
        for unit in units:
            if stop():
                break
            yield from worker.run(unit, stop)


ENGINES: dict[str, Any] = {"local": run_local, "ray": run_ray}


def run_fleet(
    job: Job,
    sources: Sequence[Any],
    layout: Layout,
    shard: Shard,
    engine: str = "local",
    about: dict[str, Any] | None = None,
    **engine_settings: Any,
) -> dict[str, Any]:
    """Compute the frames of a shard that are not complete, and write a report.

    Claim the folder of the job first (`manifest.claim_folder`). `sources` are all logs, of all shards.

    Returns:
        The report of `Counters.report` with the entries of `about`. It is also written to OUTPUT/reports/<shard>.json.
        "exit_status" is 0 if every frame of the shard is on disk, 1 if not or if the report could not be written. It is
        130 after Ctrl-C, 143 after SIGTERM and 129 after SIGHUP.
    """
    if engine not in ENGINES:
        raise CFlowError(f"engine={engine!r}: give one of {', '.join(ENGINES)}")
    units = shard.units(sources, len(layout.devices))
    counters = Counters(units)
    start = time.perf_counter()
    with StopSignal() as stop, closing(ENGINES[engine](job, units, layout, stop, **engine_settings)) as events:
        try:
            _follow(events, counters, len(units))
        except KeyboardInterrupt:
            stop.received = stop.received or signal.SIGINT
        except CFlowError as error:  # no worker is left
            if not counters.total:
                raise
            log_line(f"ended early: {error}")
        ended_by = 0 if counters.is_complete else stop.received or 0
        name = signal.Signals(ended_by).name if ended_by else ""
        report = {**counters.report(time.perf_counter() - start, layout, shard, engine, name), **(about or {})}
        report["exit_status"] = 128 + ended_by if ended_by else 0 if counters.is_complete else 1
        try:
            file = report_file(job.output, shard)
            remove_stale(file.parent)
            write_json(file, report)
        except OSError as error:
            log_line(f"the report could not be written: {error}")
            report["exit_status"] = report["exit_status"] or 1
    return report


def report_file(output: str, shard: Shard) -> Any:
    return as_path(output) / "reports" / f"shard-{shard.index}-of-{shard.count}.json"


def _follow(events: Iterator[Event], counters: Counters, num_units: int) -> None:
    """Count the events and show the progress. The total is an estimate until all logs are open."""
    with Progress() as progress:
        for event in events:
            settled = counters.add(event)
            if counters.num_opened:
                progress.total = round(counters.total * max(1, num_units / counters.num_opened))
            if isinstance(event, Failed):
                log_line(f"failed: {event.name}: {event.message}")
            elif isinstance(event, Noted) and counters.times_noted(event.message) <= _SHOWN:
                log_line(f"warning: {event.name}: {event.message}")
            progress.update(settled)
        progress.total = progress.n


class StopSignal:
    """A context in which the first of `SIGNALS` only sets `received`, and the second one raises KeyboardInterrupt.

    Schedulers send SIGTERM some seconds before they kill (preemption, time limit). Python handles signals in the main
    thread only; in other threads this does nothing.
    """

    def __init__(self) -> None:
        self.received: int | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> StopSignal:
        if threading.current_thread() is threading.main_thread():
            for number in SIGNALS:
                if number == signal.SIGINT or signal.getsignal(number) is not signal.SIG_IGN:  # nohup ignores SIGHUP
                    self._before[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: Any) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def __call__(self) -> bool:
        return self.received is not None

    def _receive(self, number: int, _: Any) -> None:
        if self.received is not None:
            raise KeyboardInterrupt
        self.received = number
        name = signal.Signals(number).name
        with suppress(OSError):  # `print` is not safe here: the signal may interrupt another one
            os.write(2, f"\n{name}: finishing the frames that have begun; repeat the signal to end at once\n".encode())
