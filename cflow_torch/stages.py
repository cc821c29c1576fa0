"""Times a method while it works: seconds per pair, and of each stage."""

from __future__ import annotations

import statistics
import time
from contextlib import contextmanager
from typing import Any, Dict, Iterator, List, Protocol, Sequence
from unittest.mock import patch

import torch
from torch.profiler import record_function

from cflow_torch.config import Config
from cflow_torch.types import FlowResult, Window


class FlowModel(Protocol):
    """What runs and clocks need of a method."""

    config: Config

    def __call__(self, windows: Sequence[Window]) -> List[FlowResult]:
        """One result per window."""


class StopWatch:
    """A method that is timed; stands in for it.

    Args:
        model: the method.

    Convention: a pair's time starts with the window in memory and ends with the result on the device. The first pair
    warms up and does not count, if there are more. A stage is a `record_function` block of the method, timed by the
    host's clock (on a GPU: the time to queue its work).
    """

    def __init__(self, model: FlowModel) -> None:
        self.model, self.config = model, model.config
        self._seconds: List[float] = []
        self._stages: List[Dict[str, float]] = []

    def __call__(self, windows: Sequence[Window]) -> List[FlowResult]:
        """What the method gives."""
        with stage_clock() as stages:
            start = time.perf_counter()
            results = self.model(windows)
            if results and results[0].flow.is_cuda:
                torch.cuda.synchronize(results[0].flow.device)
            self._seconds.append(time.perf_counter() - start)
        self._stages.append(stages)
        return results

    def report(self) -> Dict[str, Any]:
        """Seconds per pair: "median", "min", "max", "pairs" that were timed, "stages" (median of each)."""
        counted, stages = self._seconds[1:] or self._seconds, self._stages[1:] or self._stages
        if not counted:
            return {"pairs": 0}
        names = list(dict.fromkeys(name for pair in stages for name in pair))
        return {
            "median": statistics.median(counted),
            "min": min(counted),
            "max": max(counted),
            "pairs": len(counted),
            "stages": {name: statistics.median(pair.get(name, 0.0) for pair in stages) for name in names},
        }


@contextmanager
def stage_clock() -> Iterator[Dict[str, float]]:
    """Collects the seconds spent in `record_function` blocks, by name, while it is open.

    The profiler would do the same, but its bookkeeping doubles the time of so many small operations.
    """
    seconds: Dict[str, float] = {}
    started: List[float] = []

    def enter(block: Any) -> Any:
        started.append(time.perf_counter())
        return block

    def leave(block: Any, *_: Any) -> None:
        seconds[block.name] = seconds.get(block.name, 0.0) + time.perf_counter() - started.pop()

    with patch.object(record_function, "__enter__", enter), patch.object(record_function, "__exit__", leave):
        yield seconds
