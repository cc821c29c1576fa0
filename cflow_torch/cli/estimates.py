"""Flow of many pairs, one window at a time; on a CPU in worker processes, one per core.

Threads would not help: a window is thousands of small operations, and only one thread at a time runs the interpreter.
"""

from __future__ import annotations

import os
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from queue import SimpleQueue
from typing import Any, Callable, Iterator, Sequence, Tuple, TypeVar

import torch

from cflow_torch.fleet.machine import AUTO, choose_layout, frames_per_worker
from cflow_torch.fleet.processes import ChildProcess, WorkerDied
from cflow_torch.fleet.progress import frames, show_warnings_as_lines
from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.inspection import inactive_is_an_error

_AHEAD = 2  # windows per worker that are read ahead

Item = TypeVar("Item")
Answer = Callable[[], Tuple[Window, FlowResult]]


def estimates(
    model: TimedModel, items: Sequence[Item], read: Callable[[Item], Window]
) -> Iterator[tuple[Item, Answer]]:
    """Estimate the flow of many pairs. Results do not depend on the number of processes.

    Args:
        model: the method; it receives the times of all pairs.
        items: the pairs.
        read: returns the window of a pair; called in this process.

    Yields:
        Each item, in order, and a function that returns its window and flow, or raises the error of that pair.
    """
    method: Any = model.model
    most = len(items) // frames_per_worker(method.config)
    devices = choose_layout(method.device, AUTO, AUTO, os.environ, most).devices
    count = len(devices) if devices[0] == "cpu" else 1
    if count < 2:
        for item in frames(items):
            yield item, lambda item=item: _estimate(model, read(item))  # type: ignore[misc]
        return
    processes = [ChildProcess(_make_estimate, method) for _ in range(count)]
    idle: SimpleQueue[ChildProcess] = SimpleQueue()
    for process in processes:
        idle.put(process)

    def compute(sweeps: Window) -> tuple[Window, dict[str, Any], Any]:
        process = idle.get()
        try:
            return (sweeps, *process.call(sweeps))
        except WorkerDied as death:
            raise CFlowError(f"a worker process died on it {death}") from None
        finally:
            idle.put(process)

    def answer(future: Future[Any]) -> tuple[Window, FlowResult]:
        sweeps, arrays, seconds = future.result()
        model.pairs.append(seconds)
        return sweeps, FlowResult(**{name: torch.from_numpy(array) for name, array in arrays.items()})

    def take() -> tuple[Item, Answer]:
        item, future = waiting.popleft()
        return item, partial(answer, future)

    waiting: deque[tuple[Item, Future[Any]]] = deque()
    with ThreadPoolExecutor(count) as threads:
        try:
            for item in frames(items):
                future: Future[Any] = Future()
                try:
                    future = threads.submit(compute, read(item))
                except (CFlowError, OSError) as error:
                    future.set_exception(error)
                waiting.append((item, future))
                if len(waiting) > _AHEAD * count:
                    yield take()
            while waiting:
                yield take()
        finally:
            for _, future in waiting:
                future.cancel()
            for process in processes:
                process.close()


def _estimate(model: TimedModel, sweeps: Window) -> tuple[Window, FlowResult]:
    with inactive_is_an_error():
        return sweeps, model([sweeps])[0]


def _make_estimate(method: SceneFlowModel) -> Callable[[Window], tuple[dict[str, Any], Any]]:
    """Make the function that a worker process calls: window -> arrays and seconds."""
    torch.set_num_threads(1)
    show_warnings_as_lines()
    model = TimedModel(method)

    def estimate(sweeps: Window) -> tuple[dict[str, Any], Any]:
        _, result = _estimate(model, sweeps)
        return result.numpy(), model.pairs.pop()  # tensors would take shared memory, of which containers have little

    return estimate
