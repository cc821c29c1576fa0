"""Estimate the flow of many pairs, one window at a time; on a CPU in worker processes, one per core.

Threads would not help: a window is thousands of small operations, and only one thread at a time runs the interpreter.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from queue import SimpleQueue
from typing import Any, Callable, Iterator, Sequence, Tuple

import torch

from cflow_torch.cli.failures import Failures, collect_failures
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.fleet.machine import AUTO, choose_layout, frames_per_worker
from cflow_torch.fleet.processes import ChildProcess, WorkerDied
from cflow_torch.fleet.progress import Progress, show_warnings_as_lines
from cflow_torch.fleet.work import run_ahead
from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.inspection import inactive_is_an_error

_AHEAD = 2  # windows per worker that are read ahead

Pair = Tuple[Log, int]  # a log and the index of the first of two sweeps
Answer = Callable[[], Tuple[Window, FlowResult]]


def for_each_pair(
    pairs: Sequence[Pair], model: TimedModel, use: Callable[[Log, int, Window, FlowResult], None]
) -> Failures:
    """Estimate the flow of pairs, and call `use` with the log, index, window and result of each pair, in order.

    The pairs of a log must follow one another. A bad pair is reported and skipped. The times of all pairs are added to
    the model.
    """
    failures: Failures = []
    for (log, index), answer in _answers(pairs, model):
        with collect_failures(failures, f"{log.log_id}/{log.timestamps[index]}"):
            use(log, index, *answer())
    return failures


def _answers(pairs: Sequence[Pair], model: TimedModel) -> Iterator[tuple[Pair, Answer]]:
    """Yield each pair and a function that returns its window and flow, or raises the error of that pair."""
    method: Any = model.model
    config, recent = method.config, None

    def read(log: Log, index: int) -> Window:
        nonlocal recent  # the log of the last pair
        if recent is None or recent.log is not log:
            recent = CachedLog(log, config.num_sweeps)
        return window(recent, index, config.num_history, config.num_future)

    devices = choose_layout(method.device, AUTO, AUTO, os.environ).devices
    count = min(len(devices), len(pairs) // frames_per_worker(config)) if devices[0] == "cpu" else 1
    if count < 2:
        for pair in Progress(pairs):
            yield pair, lambda pair=pair: _estimate(model, read(*pair))  # type: ignore[misc]
        return
    processes = [ChildProcess(_make_estimate, method) for _ in range(count)]
    idle: SimpleQueue[ChildProcess] = SimpleQueue()
    for process in processes:
        idle.put(process)

    def try_to_read(pair: Pair) -> Window | Exception:
        try:
            return read(*pair)
        except (CFlowError, OSError) as error:
            return error

    def compute(sweeps: Window | Exception) -> tuple[Window, FlowResult]:
        if isinstance(sweeps, Exception):
            raise sweeps
        process = idle.get()
        try:
            ((arrays, seconds),) = process.call(sweeps)
        except WorkerDied as death:
            raise CFlowError(f"a worker process died on it {death}") from None
        finally:
            idle.put(process)
        model.pairs.append(seconds)
        return sweeps, FlowResult(**{name: torch.from_numpy(array) for name, array in arrays.items()})

    with ThreadPoolExecutor(count) as threads:
        try:
            with closing(run_ahead(threads, compute, map(try_to_read, pairs), _AHEAD * count)) as futures:
                for pair, future in zip(Progress(pairs), futures):
                    yield pair, future.result
        finally:
            for process in processes:
                process.close()


def _estimate(model: TimedModel, sweeps: Window) -> tuple[Window, FlowResult]:
    with inactive_is_an_error():
        return sweeps, model([sweeps])[0]


def _make_estimate(method: SceneFlowModel) -> Callable[..., Iterator[tuple[dict[str, Any], Any]]]:
    """Make the function that a worker process calls: window -> arrays and seconds."""
    torch.set_num_threads(1)
    show_warnings_as_lines()
    model = TimedModel(method)

    def estimate(sweeps: Window, stop: Callable[[], bool]) -> Iterator[tuple[dict[str, Any], Any]]:
        _, result = _estimate(model, sweeps)
        yield result.numpy(), model.pairs.pop()  # tensors would take shared memory, of which containers have little

    return estimate
