#!/usr/bin/env python3
"""Check a GPU within minutes: equality with the CPU, speed, launches, memory.

  PYTHONPATH=. python scripts/benchmarks/gpu_check.py    tables, and outputs/gpu_check.json

We have not run this script on a GPU, because we had none. Without a GPU it compares the CPU with itself, which only
tests the script.
"""

from __future__ import annotations

import argparse
import platform
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, Callable, Dict, Iterator, Sequence

import numpy as np
import torch
from table import markdown
from torch.profiler import ProfilerActivity, profile

from cflow_torch import Config, FlowResult, Sweep, Window, make_config, make_model
from cflow_torch.cli.bench import measure
from cflow_torch.data.json_file import write_json
from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive
from cflow_torch.stages import stage_seconds

TOLERANCE = 1e-4  # metres; also of scores and confidences
EXACT = ("cluster_id", "is_valid")
SCALES = (0.8, 0.4, 0.3, 0.2, 0.1)
PAPER, KEYS, DEFAULT = make_config("paper"), make_config("paper_keypoints"), make_config("default")
TWO = PAPER.replace(num_history=2, pixel_sizes=(0.4, 0.1))
SMALL = (-20.0, -20.0, -3.0, 20.0, 20.0, 5.0)
LITTLE = 30_000_000  # bytes, less than a batch needs
# name -> (settings, number of windows in a batch)
VARIANTS: dict[str, tuple[Config, int]] = {
    "dense, h = 0": (PAPER, 1),
    "dense, h = 0, +-70 m": (PAPER.replace(point_cloud_range=(-70.0, -70.0, -3.0, 70.0, 70.0, 5.0)), 1),
    "dense, h = 0, connectivity 4": (PAPER.replace(connectivity=4), 1),
    "dense, h = 0, conv": (PAPER.replace(correlation="conv", point_cloud_range=SMALL), 1),
    "dense, h = 4, 5 scales": (PAPER.replace(num_history=4, pixel_sizes=SCALES), 1),
    "dense, h = 2, 2 scales": (TWO, 3),
    "dense, h = 2, 2 scales, max_memory 30 MB": (TWO.replace(max_memory=LITTLE), 3),
    "dense, max_speed": (TWO.replace(max_speed=30.0), 1),
    "dense, sectional view": (TWO.replace(sectional_view=True), 2),
    "key points": (KEYS, 1),
    "key points, preset keypoints": (make_config("keypoints"), 1),
    "key points, nearest": (KEYS.replace(densify="nearest"), 1),
    "key points, max_memory 30 MB": (KEYS.replace(max_memory=LITTLE), 3),
    "preset default": (DEFAULT, 3),
    "preset default, h = 0": (DEFAULT.replace(num_history=0), 3),
    "preset default, max_memory 30 MB": (DEFAULT.replace(max_memory=LITTLE), 3),
}
MEASURED = ("dense, h = 4, 5 scales", "dense, h = 0", "key points", "preset default")
# Prefixes of CUDA functions, because the suffixes differ from version to version.
CALLS = {
    "launches": ("cudaLaunchKernel", "cuLaunchKernel"),
    "syncs": ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize"),
    "copies": ("cudaMemcpy", "cudaMemset"),
}
Rows = Iterator[Dict[str, Any]]


@lru_cache(maxsize=None)
def street(seed: int) -> Window:
    """A window of a simulated street, with four older sweeps."""
    return window(make_drive(seed, num_sweeps=6), 4, 4)


def streets(number: int) -> list[Window]:
    """Windows for a batch: three different ones, which are repeated."""
    return [street(7 + i % 3) for i in range(number)]


def check_equality(device: str) -> Rows:
    """Compare GPU and CPU in every variant: rows that differ in each field, the largest difference of the floats."""
    for name, (config, number) in VARIANTS.items():
        results = (make_model(config, where)(streets(number)) for where in (device, "cpu"))
        yield {"variant": name, **compare(*results)}


def compare(results: Sequence[FlowResult], expected: Sequence[FlowResult]) -> dict[str, Any]:
    """Points, points that differ in each field, the largest difference of a float, and whether all is equal."""
    row: dict[str, Any] = {"points": sum(len(result.flow) for result in expected)}
    largest = 0.0
    for a, b in zip(results, expected):
        of_device = a.numpy()
        for name, y in b.numpy().items():
            x = of_device[name]
            row[name] = row.get(name, 0) + int((x != y).reshape(len(y), -1).any(1).sum())
            if y.dtype.kind == "f":
                largest = max(largest, float(np.abs(x - y).max(initial=0)))
    is_same = all(row[name] == 0 for name in EXACT) and largest <= TOLERANCE
    return {**row, "largest_difference": largest, "same": is_same}


def measure_speed(device: str) -> Rows:
    """Milliseconds of a batch and windows per second, from NumPy arrays and from tensors on the device."""
    for name in MEASURED:
        for kind, windows in (("arrays", streets(3)), (device, [on_device(each, device) for each in streets(3)])):
            sizes = (1, 8, 32) if device == "cuda" else (1, 2)
            for size, found in measure(make_model(VARIANTS[name][0], device), windows, 3, sizes)["batches"].items():
                of_batch = {"ms": 1000 * found["median"], "windows/s": found["windows_per_s"]}
                yield {"work": name, "input": kind, "batch": size, **of_batch}


def on_device(sweeps: Window, device: str) -> Window:
    def uploaded(sweep: Sweep) -> Sweep:
        points, is_ground = (torch.from_numpy(values).to(device) for values in (sweep.points, sweep.is_ground))
        return replace(sweep, points=points, is_ground=is_ground)

    return sweeps.with_sweeps(map(uploaded, sweeps.sweeps))


def count_launches(device: str) -> Rows:
    """Kernel launches, waits and copies of warm batches; on a GPU only (tests/test_devices.py counts on a CPU)."""
    for name in MEASURED if device == "cuda" else ():
        model = make_model(VARIANTS[name][0], device)
        for size in (1, 16):
            yield {"work": name, "batch": size, **by_profiler(partial(model, streets(size)))}


def by_profiler(run: Callable[[], Any]) -> dict[str, Any]:
    """Launches, waits and copies of CUDA, and milliseconds of its kernels."""
    with stage_seconds() as stages:
        run()
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        run()
        torch.cuda.synchronize()
    events = profiler.events() or []
    on_gpu = [e for e in events if e.device_type == torch.autograd.DeviceType.CUDA and e.name not in stages]
    counts = {kind: sum(event.name.startswith(names) for event in events) for kind, names in CALLS.items()}
    counts["syncs"] -= 1  # our own
    return {**counts, "gpu_ms": sum(event.time_range.elapsed_us() for event in on_gpu) / 1000}


def measure_memory(device: str) -> Rows:
    """Peak memory of a batch, on a CPU that of the process so far, with and without a limit."""
    size = 32 if device == "cuda" else 2
    for name in MEASURED:
        for limit in (None, 1_000_000_000, 200_000_000):
            model = make_model(VARIANTS[name][0].replace(max_memory=limit), device)
            peak = measure(model, streets(size), 1, [size])["peak_bytes"] or 0
            yield {"work": name, "batch": size, "max_memory_MB": limit and limit / 1e6, "peak_MB": peak / 1e6}


PARTS: dict[str, Callable[[str], Rows]] = {
    "equality": check_equality,
    "speed": measure_speed,
    "launches": count_launches,
    "memory": measure_memory,
}


def main() -> None:
    """Run the parts, print tables, write JSON; the exit status is 1 if results differ or a part failed."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    name = torch.cuda.get_device_name() if device == "cuda" else "no GPU: the CPU is compared with itself"
    report: dict[str, Any] = {"device": name, "platform": platform.platform(), "torch": torch.__version__}
    print(report)
    wrong: list[str] = []
    for title, measured in PARTS.items():
        try:
            rows = report[title] = list(measured(device))
        except Exception as error:  # go on with the other parts
            rows, report[title] = [], f"{type(error).__name__}: {error}"
            wrong.append(f"{title}: {report[title]}")
        print(f"\n## {title}\n\n{markdown(rows)}", flush=True)
        wrong += [f"{title}: {row['variant']}" for row in rows if not row.get("same", True)]
        write_json("outputs/gpu_check.json", report)
    if wrong:
        raise SystemExit("wrong: " + "; ".join(wrong))


if __name__ == "__main__":
    main()
