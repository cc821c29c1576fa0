"""Named stages of a method, for torch's profiler and for timing."""

from __future__ import annotations

import statistics
import threading
import time
from contextlib import contextmanager
from typing import Any, Iterator, Sequence

import torch
from torch.profiler import record_function

from cflow_torch.types import FlowResult, Window

_watched = threading.local()


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name a block of work, and add its seconds to the innermost open `stage_seconds` of this thread."""
    with record_function(name):
        start = time.perf_counter()
        yield
        seconds = getattr(_watched, "seconds", None)
        if seconds is not None:
            seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


@contextmanager
def stage_seconds() -> Iterator[dict[str, float]]:
    """Collect the seconds of each stage by the clock of the host. On a GPU, this is the time to queue the work."""
    before = getattr(_watched, "seconds", None)
    _watched.seconds = {}
    try:
        yield _watched.seconds
    finally:
        _watched.seconds = before


class TimedModel:
    """Wrap a method and time every call.

    The time of a pair starts when its window is in memory, and ends when its result is on the device. The first pair is
    a warm-up and does not count, unless it is the only one.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        self.config = model.config
        self.pairs: list[tuple[float, dict[str, float]]] = []  # seconds of each call, and of its stages

    def __call__(self, windows: Sequence[Window]) -> list[FlowResult]:
        """Return the results of the method, and record the seconds."""
        with stage_seconds() as stages:
            start = time.perf_counter()
            results = self.model(windows)
            if results and results[0].flow.is_cuda:
                torch.cuda.synchronize(results[0].flow.device)
            self.pairs.append((time.perf_counter() - start, stages))
        return results

    def report(self) -> dict[str, Any]:
        """Seconds per pair: "median", "min" and "max", the number of "pairs", and "stages" (median of each)."""
        if not self.pairs:
            return {"pairs": 0}
        counted, stages = zip(*(self.pairs[1:] or self.pairs))
        names = list(dict.fromkeys(name for pair in stages for name in pair))
        return {
            "median": statistics.median(counted),
            "min": min(counted),
            "max": max(counted),
            "pairs": len(counted),
            "stages": {name: statistics.median(pair.get(name, 0.0) for pair in stages) for name in names},
        }
