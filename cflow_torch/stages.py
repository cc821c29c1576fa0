"""Named stages of a method, for torch's profiler and for timing."""

from __future__ import annotations

import statistics
import threading
import time
from contextlib import contextmanager
from typing import Any, Iterator, NamedTuple, Sequence

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


class CallTime(NamedTuple):
    """The time of a call of a method: from the windows in memory to the results on the device."""

    seconds: float
    stages: dict[str, float]  # seconds of each stage
    is_warm_up: bool  # the first call of a process, which takes longer


class TimedModel:
    """Wrap a method and time every call."""

    def __init__(self, model: Any) -> None:
        self.model = model
        self.times: list[CallTime] = []

    def __call__(self, windows: Sequence[Window], warns: bool = True) -> list[FlowResult]:
        """Return the results of the method, and record the time."""
        with stage_seconds() as stages:
            start = time.perf_counter()
            results = self.model(windows, warns)
            if results and results[0].flow.is_cuda:
                torch.cuda.synchronize(results[0].flow.device)
            self.times.append(CallTime(time.perf_counter() - start, stages, not self.times))
        return results


def time_report(times: Sequence[CallTime]) -> dict[str, Any]:
    """Return seconds per call: "median", "min" and "max", the number of "pairs", and "stages" (median of each).

    A warm-up does not count, unless there is nothing else.
    """
    counted = [each for each in times if not each.is_warm_up] or times
    if not counted:
        return {"pairs": 0}
    seconds = [each.seconds for each in counted]
    names = list(dict.fromkeys(name for each in counted for name in each.stages))
    return {
        "median": statistics.median(seconds),
        "min": min(seconds),
        "max": max(seconds),
        "pairs": len(seconds),
        "stages": {name: statistics.median(each.stages.get(name, 0.0) for each in counted) for name in names},
    }
