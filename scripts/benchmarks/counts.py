"""How much memory a model takes, counted without a clock: the same figures on a busy machine and on a fast one."""

from __future__ import annotations

import tracemalloc
from typing import Any, Callable, List, Tuple

import torch
from torch.profiler import ProfilerActivity, profile

from cflow_torch.types import FlowResult

Run = Callable[[], List[FlowResult]]


def count_allocations(run: Run) -> Tuple[int, int]:
    """Bytes that a run asks for, in sum and at most at once; no clock and no operating system in it.

    Args:
        run: called up to three times.

    Returns:
        allocated: bytes of all allocations of tensors together, temporaries inside of operations included.
        peak: most bytes held at once above those before the run; results count, the input does not.

    Convention:
        On the CPU `peak` is the largest sum of living tensors plus the largest sum of what Python and NumPy held: an
        upper bound, because the two need not meet. On a GPU it is what torch's allocator handed out there.
    """
    device = run()[0].flow.device
    if device.type == "cuda":
        return _count_on_gpu(run, device)
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler:
        run()
    # Every allocation and every release of the CPU's allocator, in order; only the raw events have those inside of
    # operations.
    events: Any = profiler.profiler
    changes = [event for event in events.kineto_results.events() if event.name() == "[memory]"]
    changes.sort(key=_start)
    allocated = now = peak = 0
    for change in changes:
        allocated += max(change.nbytes(), 0)
        now += change.nbytes()
        peak = max(peak, now)
    return allocated, peak + _python_peak(run)


def _start(event: Any) -> int:
    # torch before 2.4 counts microseconds
    return event.start_ns() if hasattr(event, "start_ns") else event.start_us()


def _python_peak(run: Run) -> int:
    """Most bytes that Python and NumPy held at once during a run above those before it."""
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        run()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def _count_on_gpu(run: Run, device: torch.device) -> Tuple[int, int]:
    """As `count_allocations`, by torch's own statistics."""
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_stats(device)
    run()
    after = torch.cuda.memory_stats(device)
    total, most, now = "allocated_bytes.all.allocated", "allocated_bytes.all.peak", "allocated_bytes.all.current"
    return after[total] - before[total], after[most] - before[now]
