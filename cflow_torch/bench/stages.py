"""Seconds of each stage, by the profiler."""

from __future__ import annotations

import statistics
from typing import Any, Callable, Dict, Sequence

import torch
from torch.profiler import ProfilerActivity, profile

# Names of the record_function blocks of each method.
STAGES = {
    "dense": ("compensate", "project", "cluster", "correlate", "pool", "spread"),
    "keypoints": ("compensate", "project", "describe", "match", "densify", "spread"),
}
_PROFILED_RUNS = 5


def stage_seconds(run: Callable[[], Any], on_gpu: bool, stages: Sequence[str]) -> Dict[str, float]:
    """Median seconds of each stage in a few profiled runs; kernels on a GPU, the host's clock otherwise."""
    activities = [ProfilerActivity.CPU] + ([ProfilerActivity.CUDA] if on_gpu else [])
    with profile(activities=activities) as profiler:
        for _ in range(_PROFILED_RUNS):
            run()
    events = [event for event in profiler.events() or [] if event.device_type == torch.autograd.DeviceType.CPU]
    events.sort(key=lambda event: event.time_range.start)
    medians = {}
    for stage in stages:
        microseconds = [_kernel_microseconds(e) if on_gpu else e.cpu_time_total for e in events if e.name == stage]
        each = len(microseconds) // _PROFILED_RUNS  # blocks of this name in one run
        totals = [sum(microseconds[i * each : (i + 1) * each]) for i in range(_PROFILED_RUNS)]
        medians[stage] = statistics.median(totals) / 1e6
    return medians


def _kernel_microseconds(event: Any) -> float:
    # torch before 2.4 calls it cuda_time_total
    return event.device_time_total if hasattr(event, "device_time_total") else event.cuda_time_total
