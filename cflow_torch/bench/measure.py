"""Seconds of the fast path, of its stages, of the reference and of the OpenCV loop."""

from __future__ import annotations

import math
import os
import platform
import statistics
import time
from contextlib import contextmanager
from dataclasses import fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

import torch
from torch.profiler import ProfilerActivity, profile

from cflow_torch.batch import make_batch
from cflow_torch.bench.opencv_loop import find_clusters, opencv, opencv_flow
from cflow_torch.cluster import cluster
from cflow_torch.config import Config
from cflow_torch.estimate import make_model
from cflow_torch.grid import Grid
from cflow_torch.reference import reference_flow
from cflow_torch.types import CFlowError, FlowResult, Window

# Names of the record_function blocks of each method.
STAGES = {
    "dense": ("compensate", "project", "cluster", "correlate", "pool", "spread"),
    "keypoints": ("compensate", "project", "describe", "match", "densify", "spread"),
}
_PROFILED_RUNS = 5
# Rest between two timed runs: worker threads of the library that ran before spin for some milliseconds after their
# last job, and would take the cores from the other one. (A product of large matrices in the OpenCV loop, whose BLAS
# threads spin longer than this, doubled the time of the fast path.)
_REST_SECONDS = 0.02
# Flows closer than this are the same: shifts are whole pixels, so different ones are a pixel (centimetres) apart, and
# float32 rounding of a flow is below 1e-6 m.
_SAME_FLOW_M = 1e-5

Report = Dict[str, Any]


def run_bench(
    windows: Sequence[Window],
    configs: Mapping[str, Config],
    *,
    repeats: int = 20,
    with_reference: bool = True,
    with_opencv: bool = True,
    num_threads: Optional[int] = None,
    device: Any = "auto",
) -> Report:
    """Time the method on windows, one window at a time, on the same data in the same process as its competitors.

    Args:
        windows: at least one; history beyond a config's `num_history` is left out for that config.
        configs: name -> settings.
        repeats: timed runs of the fast path and of the OpenCV loop, in turn: fast, OpenCV, fast, OpenCV, ...
        with_reference: also run the slow reference, once per window.
        with_opencv: also run the OpenCV loop, if OpenCV is installed.
        num_threads: threads of torch and OpenCV during the measurement; None = as many as torch has now.
        device: as for `make_model`; the OpenCV loop and the reference run on the CPU in any case.

    Returns:
        A dictionary ready for strict JSON: "machine", "num_windows", "points" (mean number per sweep), "repeats",
        "results": name -> "config", "fast", "opencv", "reference" ("median_s", "min_s", "max_s"), "stages_s",
        "opencv_over_fast", "agreement", "clustering", "peak_extra_mb". All seconds are per window. What was not
        measured is a text that says why.

    Convention:
        "fast" starts with the window as given and ends with the `FlowResult` on the device, the device synchronised;
        the profiler is off. "stages_s" comes from separate runs under the profiler, which slows them; on a GPU it is
        the time of the kernels. "opencv_over_fast" is the median of the ratios of neighbouring runs, so a slow spell
        of the machine hits both; above 1 the fast path is faster.

    Raises:
        CFlowError: no windows, no configs, `repeats` below 1, bad windows.

    Cost: (repeats + 10) runs of each, and the reference takes seconds per window.
    """
    if not windows or not configs or repeats < 1:
        raise CFlowError("a benchmark needs at least one window, one config and repeats >= 1")
    found = _has_opencv()
    why_no_opencv = "not run" if not with_opencv else "" if found else "not installed"
    results = {}
    with _threads(num_threads, found) as threads:
        for name, config in configs.items():
            trimmed = [replace(window, pch=tuple(window.pch)[: config.num_history]) for window in windows]
            results[name] = _measure(trimmed, config, repeats, with_reference, why_no_opencv, device)
        machine = _machine(threads, make_model(config, device)(trimmed[:1])[0].flow.device)
    sweeps = [sweep for window in windows for sweep in (window.pc0, window.pc1, *window.pch)]
    return {
        "machine": machine,
        "num_windows": len(windows),
        "points": round(statistics.mean(len(sweep.points) for sweep in sweeps)),
        "repeats": repeats,
        "results": results,
    }


def _measure(
    windows: List[Window], config: Config, repeats: int, with_reference: bool, why_no_opencv: str, device: Any
) -> Report:
    """The entry of one config, see `run_bench`."""
    model = make_model(config, device)
    plain = config.method == "dense" and config.clustering == "components"
    if not why_no_opencv and (config.sectional_view or not plain):
        why_no_opencv = "has no sectional view" if plain else "has no such method"

    def fast() -> List[FlowResult]:
        results = [model([window])[0] for window in windows]
        _synchronise(results[0].flow)
        return results

    def loop() -> List[FlowResult]:
        return [opencv_flow(window, config) for window in windows]

    per_run = 1 / len(windows)
    peak_extra_mb, flows = measure_peak(fast)
    opencv_seconds: Any = why_no_opencv
    ratio: Any = why_no_opencv
    agreement: Report = {"opencv": why_no_opencv, "reference": "not run"}
    if why_no_opencv:
        (fast_times,) = _alternate([fast], repeats)
    else:
        agreement["opencv"] = _agreement(flows, loop(), config)
        fast_times, loop_times = _alternate([fast, loop], repeats)
        opencv_seconds = _summary([t * per_run for t in loop_times])
        ratio = statistics.median(b / a for a, b in zip(fast_times, loop_times))
    reference_seconds: Any = "not run"
    if with_reference and config.clustering == "hdbscan":
        reference_seconds = agreement["reference"] = "not measured for this method"
    elif with_reference:
        start = time.perf_counter()
        expected = [reference_flow(window, config) for window in windows]
        reference_seconds = _summary([(time.perf_counter() - start) * per_run])
        agreement["reference"] = _same_bits(flows, expected)
    return {
        "config": {key: _jsonable(value) for key, value in config.as_dict().items()},
        "fast": _summary([t * per_run for t in fast_times]),
        "stages_s": {stage: t * per_run for stage, t in _stage_seconds(fast, flows[0], STAGES[config.method]).items()},
        "opencv": opencv_seconds,
        "opencv_over_fast": ratio,
        "reference": reference_seconds,
        "agreement": agreement,
        "clustering": _measure_clustering(windows[0], config, repeats, why_no_opencv, device),
        "peak_extra_mb": peak_extra_mb,
    }


def _measure_clustering(window: Window, config: Config, repeats: int, why_no_opencv: str, device: Any) -> Report:
    """Occupancy images -> clusters with boxes (dilate, label, erode, label again, number), finest scale, one window."""
    if config.method != "dense":
        return {"fast": "no clustering", "opencv": "no clustering"}
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    grid = Grid(config.pixel_sizes[-1], (x0, y0, z0), (x1, y1, z1))
    batch = make_batch([window], config, grid, device)
    occupancy, _ = grid.project(batch.positions, batch.image, batch.num_steps, batch.takes_part)
    images = [image.byte().cpu().numpy() for image in occupancy]

    def fast() -> None:
        cluster(occupancy[None], grid.pixel_size, config)
        _synchronise(occupancy)

    if why_no_opencv:
        return {"fast": _summary(_alternate([fast], repeats)[0]), "opencv": why_no_opencv}
    times, loop_times = _alternate([fast, lambda: find_clusters(images, grid.pixel_size, config)], repeats)
    return {
        "fast": _summary(times),
        "opencv": _summary(loop_times),
        "opencv_over_fast": statistics.median(b / a for a, b in zip(times, loop_times)),
    }


def _alternate(runs: Sequence[Callable[[], Any]], repeats: int) -> List[List[float]]:
    """Seconds of each of `repeats` runs, taken in turn after two rounds that do not count.

    Every timed run follows an untimed one of the same kind (a A b B a A b B ...): frames come one after the other, and
    right after the rest threads are asleep and memory belongs to the other.
    """
    times: List[List[float]] = [[] for _ in runs]
    for repeat in range(-2, repeats):
        for run, seconds in zip(runs, times):
            time.sleep(_REST_SECONDS)
            run()
            start = time.perf_counter()
            run()
            if repeat >= 0:
                seconds.append(time.perf_counter() - start)
    return times


def _stage_seconds(run: Callable[[], Any], result: FlowResult, stages: Sequence[str]) -> Dict[str, float]:
    """Median seconds of each stage in a few profiled runs; kernels on a GPU, the host's clock otherwise."""
    on_gpu = result.flow.is_cuda
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


def _agreement(flows: Sequence[FlowResult], others: Sequence[FlowResult], config: Config) -> Report:
    """Share of the valid points with the same residual flow, and with one at most a (coarsest) pixel per axis away."""
    valid = torch.cat([flow.is_valid.cpu() for flow in flows])
    pairs = zip(flows, others)
    distance = torch.cat([(a.residual_flow.cpu() - b.residual_flow).abs().amax(1) for a, b in pairs])[valid]
    share = [float((distance <= limit + _SAME_FLOW_M).double().mean()) for limit in (0.0, config.pixel_sizes[0])]
    share = share if len(distance) else [1.0, 1.0]
    return {"same_flow": share[0], "within_one_pixel": share[1], "points": len(distance)}


def _same_bits(flows: Sequence[FlowResult], others: Sequence[FlowResult]) -> Dict[str, bool]:
    """For each field of the result, whether it is equal everywhere, and whether all are."""
    names = [field.name for field in fields(FlowResult)]
    same = {n: all(torch.equal(getattr(a, n).cpu(), getattr(b, n)) for a, b in zip(flows, others)) for n in names}
    return {"bit_equal": all(same.values()), **same}


def measure_peak(run: Callable[[], List[FlowResult]]) -> Tuple[Union[float, str], List[FlowResult]]:
    """Most memory held during a run above that before it, MB, and what the run returned.

    On a GPU torch's own count; on Linux the high-water mark of the resident set, which can be reset; else not measured.
    On Linux it is a lower bound: memory that the C library kept from earlier runs is used again and not seen, so later
    configs may show 0.
    """
    results = run()
    device = results[0].flow.device
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        before = torch.cuda.memory_allocated(device)
        run()
        return (torch.cuda.max_memory_allocated(device) - before) / 1e6, results
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before_kb, _ = _resident_kb()
        run()
        _, peak_kb = _resident_kb()
    except (OSError, KeyError):
        return "not measured", results
    return max(peak_kb - before_kb, 0) * 1024 / 1e6, results


def _resident_kb() -> Tuple[int, int]:
    """Resident set now and its high-water mark."""
    lines = Path("/proc/self/status").read_text().splitlines()
    values = {line.split(":")[0]: line.split()[1] for line in lines if line.startswith("Vm")}
    return int(values["VmRSS"]), int(values["VmHWM"])


def _machine(threads: int, device: torch.device) -> Dict[str, Any]:
    """What the figures depend on."""
    return {
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": threads,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
        "python": platform.python_version(),
        "versions": {
            **{package: metadata.version(package) for package in ("torch", "numpy", "kornia")},
            "opencv": opencv().__version__ if _has_opencv() else "not installed",
        },
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or "unknown"


@contextmanager
def _threads(num_threads: Optional[int], with_opencv: bool) -> Iterator[int]:
    """The same number of threads for torch and OpenCV; as before afterwards."""
    before = torch.get_num_threads()
    threads = num_threads or before
    opencv_before = opencv().getNumThreads() if with_opencv else 0
    try:
        torch.set_num_threads(threads)
        if with_opencv:
            opencv().setNumThreads(threads)
        yield threads
    finally:
        torch.set_num_threads(before)
        if with_opencv:
            opencv().setNumThreads(opencv_before)


def _has_opencv() -> bool:
    try:
        opencv()
    except CFlowError:
        return False
    return True


def _synchronise(tensor: torch.Tensor) -> None:
    if tensor.is_cuda:
        torch.cuda.synchronize(tensor.device)


def _summary(seconds: Sequence[float]) -> Dict[str, float]:
    return {"median_s": statistics.median(seconds), "min_s": min(seconds), "max_s": max(seconds)}


def _jsonable(value: Any) -> Any:
    """Strict JSON has no infinity: it becomes a text."""
    if isinstance(value, list):
        return [_jsonable(v) for v in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
