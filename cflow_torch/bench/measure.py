"""The method, its reference and the OpenCV loop on the same windows, in turn, in one process."""

from __future__ import annotations

import math
import statistics
import time
from dataclasses import replace
from typing import Any, Dict, List, Mapping, Optional, Sequence

from oracle import reference_flow

from cflow_torch.bench.agreement import same_bits, share_agreement
from cflow_torch.bench.clustering import measure_clustering
from cflow_torch.bench.machine import describe_machine, has_opencv
from cflow_torch.bench.memory import measure_peak
from cflow_torch.bench.opencv_loop import opencv_flow
from cflow_torch.bench.stages import STAGES, stage_seconds
from cflow_torch.bench.timing import alternate, median_ratio, summary, synchronise, threads
from cflow_torch.bench.work import count_work
from cflow_torch.checks import DENSE_ONLY
from cflow_torch.config import Config
from cflow_torch.estimate import make_model
from cflow_torch.types import CFlowError, FlowResult, Window

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
        "opencv_over_fast", "agreement", "clustering" (see `measure_clustering`), "peak_extra_mb", "work" (of the first
        window, see `Work`). All seconds are per window. What was not measured is a text that says why.

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
    why_no_opencv = "not run" if not with_opencv else "" if has_opencv() else "not installed"
    results = {}
    with threads(num_threads) as number:
        for name, config in configs.items():
            trimmed = [trim_history(window, config) for window in windows]
            results[name] = _measure(trimmed, config, repeats, with_reference, why_no_opencv, device)
        machine = describe_machine(number, make_model(config, device)(trimmed[:1])[0].flow.device)
    sweeps = [sweep for window in windows for sweep in (window.pc0, window.pc1, *window.pch)]
    return {
        "machine": machine,
        "num_windows": len(windows),
        "points": round(statistics.mean(len(sweep.points) for sweep in sweeps)),
        "repeats": repeats,
        "results": results,
    }


def trim_history(window: Window, config: Config) -> Window:
    """The window without the older sweeps that a config does not take."""
    return replace(window, pch=tuple(window.pch)[: config.num_history])


def plain_config(config: Config) -> Dict[str, Any]:
    """Settings as strict JSON has them: infinity is a text."""
    return {key: _jsonable(value) for key, value in config.as_dict().items()}


def _measure(
    windows: List[Window], config: Config, repeats: int, with_reference: bool, why_no_opencv: str, device: Any
) -> Report:
    """The entry of one config, see `run_bench`."""
    model = make_model(config, device)
    is_paper = all(getattr(config, name) == off for name, off in DENSE_ONLY.items())
    plain = config.method == "dense" and config.clustering == "components" and is_paper
    why_no_loop = why_no_opencv
    if not why_no_opencv and (config.sectional_view or not plain):
        why_no_loop = "has no sectional view" if plain else "has no such method"

    def fast() -> List[FlowResult]:
        results = [model([window])[0] for window in windows]
        synchronise(results[0].flow)
        return results

    def loop() -> List[FlowResult]:
        return [opencv_flow(window, config) for window in windows]

    per_run = 1 / len(windows)
    peak_extra_mb, flows = measure_peak(fast)
    opencv_seconds: Any = why_no_loop
    ratio: Any = why_no_loop
    agreement: Report = {"opencv": why_no_loop, "reference": "not run"}
    if why_no_loop:
        (fast_times,) = alternate([fast], repeats)
    else:
        agreement["opencv"] = share_agreement(flows, loop(), config)
        fast_times, loop_times = alternate([fast, loop], repeats)
        opencv_seconds = summary([t * per_run for t in loop_times])
        ratio = median_ratio(fast_times, loop_times)
    reference_seconds: Any = "not run"
    if with_reference and config.clustering == "hdbscan":
        reference_seconds = agreement["reference"] = "not measured for this method"
    elif with_reference:
        start = time.perf_counter()
        expected = [reference_flow(window, config) for window in windows]
        reference_seconds = summary([(time.perf_counter() - start) * per_run])
        agreement["reference"] = same_bits(flows, expected)
    stages = stage_seconds(fast, flows[0].flow.is_cuda, STAGES[config.method])
    return {
        "config": plain_config(config),
        "fast": summary([t * per_run for t in fast_times]),
        "stages_s": {stage: t * per_run for stage, t in stages.items()},
        "opencv": opencv_seconds,
        "opencv_over_fast": ratio,
        "reference": reference_seconds,
        "agreement": agreement,
        "clustering": measure_clustering(windows[0], config, repeats, why_no_opencv, device),
        "peak_extra_mb": peak_extra_mb,
        "work": count_work(model, windows[:1]).as_dict(),
    }


def _jsonable(value: Any) -> Any:
    if isinstance(value, list):
        return [_jsonable(v) for v in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value
