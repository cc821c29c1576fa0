"""Estimate the flow of many pairs, one window at a time; on a CPU in worker processes, one per core.

Threads would not help: a window is thousands of small operations, and only one thread at a time runs the interpreter.
"""

from __future__ import annotations

import os
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import tee
from queue import SimpleQueue
from typing import Any, Callable, Iterable, Iterator, Sequence, Tuple

import numpy as np
import torch

from cflow_torch.cli.failures import Failures, collect_failures
from cflow_torch.config import Config
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.diagnosis.inspection import inactive_problems
from cflow_torch.fleet.executors import ProcessExecutor
from cflow_torch.fleet.machine import choose_devices, frames_per_worker
from cflow_torch.fleet.progress import Progress, show_warnings_as_lines
from cflow_torch.fleet.work import run_ahead
from cflow_torch.model import SceneFlowModel
from cflow_torch.setting import AUTO
from cflow_torch.stages import CallTime, TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.memory import keep_freed_memory

_AHEAD = 2  # windows per worker that are read ahead

LogPair = Tuple[Log, int]  # a log and the index of the first of two sweeps
Answer = Callable[[], Tuple[Window, FlowResult, CallTime]]


def for_each_pair(
    pairs: Sequence[LogPair],
    model: SceneFlowModel,
    use: Callable[[Log, int, Window, FlowResult], None],
    times: list[CallTime] | None = None,
    needs: Callable[[Log, int], bool] = lambda log, index: True,
) -> Failures:
    """Estimate the flow of pairs, and call `use` with the log, index, window and result of each pair, in order.

    The pairs of a log must follow one another. Pairs for which `needs` is False are left out; we ask before we read
    their window. A bad pair is reported and skipped. The times of all pairs are added to `times`.
    """
    failures: Failures = []
    for (log, index), answer in _answers(pairs, model, needs):
        with collect_failures(failures, f"{log.log_id}/{log.timestamps[index]}"):
            sweeps, result, time = answer()
            if times is not None:
                times.append(time)
            use(log, index, sweeps, result)
    return failures


def _answers(
    pairs: Sequence[LogPair], model: SceneFlowModel, needs: Callable[[Log, int], bool]
) -> Iterator[tuple[LogPair, Answer]]:
    """Yield each pair and a function that returns its window, flow and time, or raises the error of that pair."""
    devices = choose_devices(model.device, AUTO, os.environ)
    count = min(len(devices), len(pairs) // frames_per_worker(model.config)) if devices[0] == "cpu" else 1
    needed, ahead = tee(pair for pair in Progress(pairs) if needs(*pair))
    windows = _windows(ahead, model.config)
    if count < 2:
        timed = TimedModel(model)
        yield from zip(needed, (partial(_estimate, timed, sweeps) for sweeps in windows))
        return
    executors = [ProcessExecutor(partial(_Estimator, model)) for _ in range(count)]
    idle: SimpleQueue[ProcessExecutor] = SimpleQueue()
    for executor in executors:
        idle.put(executor)
    threads = ThreadPoolExecutor(count)
    try:
        answers = run_ahead(threads, partial(_estimate_elsewhere, idle), windows, _AHEAD * count)
        yield from zip(needed, (partial(_answer, answer) for answer in answers))
    finally:
        for executor in executors:
            executor.close()
        threads.shutdown()


def _windows(pairs: Iterable[LogPair], config: Config) -> Iterator[Window | Exception]:
    """Read the window of each pair. An error is yielded, so that the next windows follow."""
    recent: CachedLog | None = None  # the log of the last pair
    for log, index in pairs:
        if recent is None or recent.log is not log:
            recent = CachedLog(log, config.num_sweeps)
        try:
            yield window(recent, index, config.num_history, config.num_future)
        except (CFlowError, OSError) as error:
            yield error


def _estimate(timed: TimedModel, sweeps: Window | Exception) -> tuple[Window, FlowResult, CallTime]:
    if isinstance(sweeps, Exception):
        raise sweeps
    results = timed([sweeps], warns=False)
    (problem,) = inactive_problems([sweeps], results, timed.model.config)
    if problem:
        raise CFlowError(problem)
    return sweeps, results[0], timed.times[-1]


def _estimate_elsewhere(
    idle: SimpleQueue[ProcessExecutor], sweeps: Window | Exception
) -> tuple[Window, dict[str, np.ndarray], CallTime]:
    """Estimate a window in an idle worker process. If the process ends, try once more, in another one."""
    if isinstance(sweeps, Exception):
        raise sweeps
    executor = idle.get()
    try:
        with suppress(BrokenExecutor):
            return (sweeps, *executor.call("estimate", sweeps))
        return (sweeps, *executor.call("estimate", sweeps))
    except BrokenExecutor as error:
        raise CFlowError(f"2 worker processes died on it, the last one: {error}") from None
    finally:
        idle.put(executor)


def _answer(answer: Future[Any]) -> tuple[Window, FlowResult, CallTime]:
    sweeps, arrays, time = answer.result()
    return sweeps, FlowResult(**{name: torch.from_numpy(array) for name, array in arrays.items()}), time


class _Estimator:
    """The model of a worker process."""

    def __init__(self, model: SceneFlowModel) -> None:
        torch.set_num_threads(1)
        keep_freed_memory()
        show_warnings_as_lines()
        self._timed = TimedModel(model)

    def estimate(self, sweeps: Window) -> tuple[dict[str, Any], CallTime]:
        """Return arrays, because tensors would take shared memory, of which containers have little; and the time."""
        _, result, time = _estimate(self._timed, sweeps)
        return result.numpy(), time
