"""Memory held during a run above that before it: counted from allocations, and seen from outside."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any, Callable, List, Tuple, Union

import torch
from torch.profiler import ProfilerActivity, profile

from cflow_torch.types import FlowResult


def measure_peak(run: Callable[[], List[FlowResult]]) -> Tuple[Union[float, str], List[FlowResult]]:
    """Most memory held during a run above that before it, MB, and what the run returned.

    On a GPU torch's own count; on Linux the high-water mark of the resident set, which can be reset; else not measured.
    On Linux it is a lower bound: memory that the C library kept from earlier runs is used again and not seen, so later
    configs may show 0. `count_allocations` has no such blind spot, but does not see what libraries take for themselves.
    """
    results = run()
    device = results[0].flow.device
    if device.type == "cuda":
        return _count_on_gpu(run, device)[1] / 1e6, results
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before_kb, _ = _resident_kb()
        run()
        _, peak_kb = _resident_kb()
    except (OSError, KeyError):
        return "not measured", results
    return max(peak_kb - before_kb, 0) * 1024 / 1e6, results


def count_allocations(run: Callable[[], List[FlowResult]]) -> Tuple[int, int]:
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
    changes = [event for event in _raw_events(profiler) if event.name() == "[memory]"]
    changes.sort(key=_start)
    allocated = now = peak = 0
    for change in changes:
        allocated += max(change.nbytes(), 0)
        now += change.nbytes()
        peak = max(peak, now)
    return allocated, peak + _python_peak(run)


def _raw_events(profiler: Any) -> List[Any]:
    return list(profiler.profiler.kineto_results.events())


def _start(event: Any) -> int:
    # torch before 2.4 counts microseconds
    return event.start_ns() if hasattr(event, "start_ns") else event.start_us()


def _python_peak(run: Callable[[], Any]) -> int:
    """Most bytes that Python and NumPy held at once during a run above those before it."""
    was_tracing = tracemalloc.is_tracing()
    if not was_tracing:
        tracemalloc.start()
    try:
        tracemalloc.clear_traces()
        before, _ = tracemalloc.get_traced_memory()
        run()
        _, peak = tracemalloc.get_traced_memory()
    finally:
        if not was_tracing:
            tracemalloc.stop()
    return peak - before


def _count_on_gpu(run: Callable[[], Any], device: torch.device) -> Tuple[int, int]:
    """As `count_allocations`, by torch's own statistics."""
    torch.cuda.synchronize(device)
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_stats(device)
    run()
    after = torch.cuda.memory_stats(device)
    total, most, now = "allocated_bytes.all.allocated", "allocated_bytes.all.peak", "allocated_bytes.all.current"
    return after[total] - before[total], after[most] - before[now]


def _resident_kb() -> Tuple[int, int]:
    """Resident set now and its high-water mark."""
    lines = Path("/proc/self/status").read_text().splitlines()
    values = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
    return int(values["VmRSS"]), int(values["VmHWM"])
