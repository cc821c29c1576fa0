"""Flow of many pairs, a window at a time: on a CPU in worker processes, one per core.

Not in threads: a window is thousands of small operations, which take turns at the interpreter.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections import deque
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, Callable, Iterator, Sequence, Tuple, TypeVar

import torch

from cflow_torch.fleet.machine import AUTO, choose_layout
from cflow_torch.fleet.progress import frames
from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import TimedModel
from cflow_torch.types import CFlowError, FlowResult, Window

_PAIRS_PER_WORKER = 50  # at least: a process takes as long to start as some 30 windows
_AHEAD = 2  # windows per worker that are read ahead

Item = TypeVar("Item")
Answer = Callable[[], Tuple[Window, FlowResult]]


def estimates(
    model: TimedModel, items: Sequence[Item], read: Callable[[Item], Window]
) -> Iterator[tuple[Item, Answer]]:
    """Flow of many pairs; it does not depend on the number of processes.

    Args:
        model: the method; its times are those of the pairs, wherever they are computed.
        items: the pairs.
        read: gives the window of one, in this process.

    Yields:
        Each item, in order, and a call that gives its window and flow, or raises what went wrong with it.
    """
    method: Any = model.model
    devices = choose_layout(method.device, AUTO, AUTO, os.environ).devices
    count = min(len(devices), len(items) // _PAIRS_PER_WORKER) if devices[0] == "cpu" else 1
    if count < 2:
        for item in frames(items):
            yield item, lambda item=item: _here(model, read(item))  # type: ignore[misc]
        return
    waiting: deque[tuple[Item, Answer]] = deque()
    context = multiprocessing.get_context("spawn")  # fork and threads do not go together
    with ProcessPoolExecutor(count, context, initializer=_begin, initargs=(method,)) as pool:
        for item in frames(items):
            waiting.append((item, _there(model, pool, item, read)))
            if len(waiting) > _AHEAD * count:
                yield waiting.popleft()
        yield from waiting


def _here(model: TimedModel, sweeps: Window) -> tuple[Window, FlowResult]:
    return sweeps, model([sweeps])[0]


def _there(model: TimedModel, pool: ProcessPoolExecutor, item: Item, read: Callable[[Item], Window]) -> Answer:
    """Read a window and give it to a worker; the answer waits for it."""
    future: Future = Future()
    try:
        sweeps = read(item)
        future = pool.submit(_compute, sweeps)
    except (CFlowError, OSError, BrokenProcessPool) as error:
        future.set_exception(error)

    def answer() -> tuple[Window, FlowResult]:
        try:
            arrays, seconds = future.result()
        except BrokenProcessPool:
            raise CFlowError("a worker process died: out of memory?") from None
        model.pairs.append(seconds)
        return sweeps, FlowResult(**{name: torch.from_numpy(array) for name, array in arrays.items()})

    return answer


_model: TimedModel  # of a worker process


def _begin(method: SceneFlowModel) -> None:
    """A worker process begins. Ctrl-C is the business of its parent."""
    global _model
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    _model = TimedModel(method)


def _compute(sweeps: Window) -> tuple[Any, ...]:
    """Arrays, because tensors would go through shared memory, of which containers have little; and seconds."""
    (result,) = _model([sweeps])
    return result.numpy(), _model.pairs.pop()
