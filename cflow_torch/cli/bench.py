"""Measure run time and memory: `cflow bench`."""

from __future__ import annotations

from typing import Any, Sequence

import torch

from cflow_torch.cli.commands import Bench
from cflow_torch.cli.logs import open_first_log
from cflow_torch.cli.outputs import machine, output_folder
from cflow_torch.config import Config
from cflow_torch.data.atomic import ensure_writable
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import Log, window
from cflow_torch.estimate import make_model
from cflow_torch.evaluation.tables import markdown
from cflow_torch.fleet.manifest import versions
from cflow_torch.model import SceneFlowModel
from cflow_torch.stages import TimedModel, time_report
from cflow_torch.types import Window
from cflow_torch.windows.memory import peak_memory


def task(cfg: Bench) -> None:
    output = output_folder(cfg)
    model = make_model(cfg.model, cfg.device)
    log = open_first_log(cfg.data)
    windows = _windows(log, cfg.pairs, model.config)
    ensure_writable(output)
    report = {"log": log.log_id, **measure(model, windows, cfg.repeats, cfg.batches), "machine": machine()}
    report.update(versions=versions(), model=model.config.as_dict())
    print(_table(report))
    write_json(output / "bench.json", report)
    print(f"written to {output / 'bench.json'}")


def measure(
    model: SceneFlowModel, windows: Sequence[Window], repeats: int, batches: Sequence[int] = ()
) -> dict[str, Any]:
    """Measure the seconds and the memory of a method, `repeats` times for each window and batch size.

    A warm-up run comes first. A batch that is larger than the number of windows repeats windows.

    Returns:
        "points" (mean number per sweep), "windows", "repeats", "device"; "seconds": of one window, see
        `time_report`; "batches": size -> "median" (seconds of a batch), "windows_per_s"; "peak_bytes": on a GPU
        the most that was allocated at once, on a CPU the most that the process ever used, None = not known.
    """
    watch = TimedModel(model)
    device = watch(windows[:1])[0].flow.device
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    for _ in range(repeats):
        for each in windows:
            watch([each])
    throughput = {}
    for size in batches:
        of_batch = TimedModel(model)
        for _ in range(1 + repeats):
            of_batch([windows[i % len(windows)] for i in range(size)])
        median = time_report(of_batch.times)["median"]
        throughput[size] = {"median": median, "windows_per_s": size / median}
    sweeps = [sweep for each in windows for sweep in each.sweeps]
    return {
        "points": sum(len(sweep.points) for sweep in sweeps) / len(sweeps),
        "windows": len(windows),
        "repeats": repeats,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else str(device),
        "seconds": time_report(watch.times),
        "batches": throughput,
        "peak_bytes": torch.cuda.max_memory_allocated(device) if device.type == "cuda" else peak_memory(),
    }


def _table(report: dict[str, Any]) -> str:
    seconds, model = report["seconds"], report["model"]
    peak = "unknown" if report["peak_bytes"] is None else f"{report['peak_bytes'] / 1e6:.0f} MB"
    times = {"total, median": seconds["median"], "min": seconds["min"], "max": seconds["max"], **seconds["stages"]}
    lines = [
        f"method {model['method']}, num_history {model.get('num_history', 0)}, pixel_sizes {model['pixel_sizes']}",
        f"device {report['device']}; {report['machine']['cpu']}, one thread",
        f"log {report['log']}: {report['windows']} pairs, {report['points']:.0f} points per sweep, each "
        f"{report['repeats']} times; torch {report['versions']['torch']}",
        f"peak memory (CPU: of the process, GPU: allocated): {peak}",
        "",
        *markdown(["one window", "ms"], [[name, f"{1000 * value:.1f}"] for name, value in times.items()]),
    ]
    batches = [[n, f"{1000 * b['median']:.1f}", f"{b['windows_per_s']:.1f}"] for n, b in report["batches"].items()]
    if batches:
        lines += ["", *markdown(["windows in a batch", "ms", "windows per second"], batches)]
    return "\n".join(lines)


def _windows(log: Log, count: int, config: Config) -> list[Window]:
    """Read `count` windows, spread evenly over those with whole history and future; if there are none, read one."""
    end = len(log.timestamps) - 2
    first = min(config.num_history, end)
    last = max(end - config.num_future, first)
    count = min(count, last - first + 1)
    chosen = [first + (last - first) * i // max(count - 1, 1) for i in range(count)]
    return [window(log, index, config.num_history, config.num_future) for index in chosen]
