#!/usr/bin/env python3
"""Everything that needs a GPU, in one run of at most eight minutes: bits, tests, speed, launches, memory.

  PYTHONPATH=. python scripts/gpu_check.py                         tables, and outputs/gpu_check.json
  PYTHONPATH=. python scripts/gpu_check.py --output FILE --skip tests
  PYTHONPATH=. python scripts/gpu_check.py --windows FILE.npz      simulated windows: made once, then read

Needs torch and NumPy; pyarrow for the simulator, unless the windows were made elsewhere; pytest for the tests. Without
a GPU it compares the CPU with itself, which shows that the script works and nothing else. Parts that the time does not
allow are left out, and it says so.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
import warnings
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Callable, Dict, List, Sequence, Tuple

import numpy as np
import torch
from torch.profiler import ProfilerActivity, profile

from cflow_torch import Config, FlowResult, Sweep, Window, make_config, make_model
from cflow_torch.bench.machine import describe_machine
from cflow_torch.bench.measure import trim_history
from cflow_torch.bench.memory import count_allocations
from cflow_torch.bench.stages import STAGES
from cflow_torch.bench.target_row import FULL, NAMES, PAIR
from cflow_torch.bench.throughput import measure_throughput
from cflow_torch.bench.work import count_work
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch

ROOT = Path(__file__).resolve().parents[1]
BUDGET_SECONDS = 440.0
TEST_SECONDS = 150.0
FLOAT_TOLERANCE = 1e-5  # metres; scores too
EXACT = ("cluster_id", "is_valid", "residual_flow")  # labels, and shifts or matches: whole pixels
KEYS = {"method": "keypoints"}
FAST = {"num_history": 2, "pixel_sizes": (0.4, 0.1)}
# name -> (what it changes in the paper's settings, number of windows in a batch)
DEFAULT = make_config("default").as_dict()
VARIANTS: Dict[str, Tuple[Dict[str, Any], int]] = {
    "dense, h = 0": ({}, 1),
    "dense, h = 0, +-70 m": ({"point_cloud_range": (-70.0, -70.0, -3.0, 70.0, 70.0, 5.0)}, 1),
    "dense, h = 0, connectivity 4": ({"connectivity": 4}, 1),
    "dense, h = 0, conv": ({"correlation": "conv", "point_cloud_range": (-20.0, -20.0, -3.0, 20.0, 20.0, 5.0)}, 1),
    "dense, h = 4": ({"num_history": 4}, 1),
    "dense, h = 4, 5 scales": ({"num_history": 4, "pixel_sizes": FULL.pixel_sizes}, 1),
    "dense, h = 2, 2 scales, batch 3": (FAST, 3),
    "dense, h = 2, 2 scales, batch 3, max_memory 30 MB": ({**FAST, "max_memory": 30_000_000}, 3),
    "dense, max_speed, time stamps": ({**FAST, "max_speed": 30.0, "use_timestamps": True}, 1),
    "dense, sectional view": ({**FAST, "sectional_view": True}, 2),
    "key points": (KEYS, 1),
    "key points, L = 41, clusters": ({**KEYS, "densify": "clusters", "patch_size": 41, "ratio_threshold": 1.02}, 1),
    "key points, nearest, mutual, 2nd best apart": (
        {**KEYS, "densify": "nearest", "mutual_check": True, "second_best_distance": 3.0},
        1,
    ),
    "key points, batch 3, max_memory 30 MB": ({**KEYS, "max_memory": 30_000_000}, 3),
    "preset default, batch 3": (DEFAULT, 3),
    "preset default, h = 0, nudge, batch 3": ({**DEFAULT, "num_history": 0, "nudge": True}, 3),
    "preset default, batch 3, max_memory 30 MB": ({**DEFAULT, "max_memory": 30_000_000}, 3),
    "preset fast, batch 3": (make_config("fast").as_dict(), 3),
}
SPEED: Dict[str, Config] = {
    NAMES[FULL]: FULL,
    NAMES[PAIR]: PAIR,
    "key points, preset paper": make_config("paper", method="keypoints"),
    "preset default": make_config("default"),
}
# Beginnings of the names of calls into CUDA: the ends differ from version to version.
LAUNCHES = ("cudaLaunchKernel", "cuLaunchKernel")
WAITS = ("cudaStreamSynchronize", "cudaDeviceSynchronize", "cudaEventSynchronize")
COPIES = ("cudaMemcpy", "cudaMemset")
ANNOTATIONS = {stage for stages in STAGES.values() for stage in stages}  # not kernels, though on the GPU's time line

Rows = List[Dict[str, Any]]


SEEDS = (7, 8, 9)
SWEEPS = 6  # t + 1, t, and a history of four
STREETS: List[Window] = []  # filled by `main`


def make_streets() -> Dict[str, np.ndarray]:
    """Simulated windows as arrays: points, ground, pose and time of every sweep, t+1 first."""
    from cflow_torch.data.log import window
    from cflow_torch.simulator import make_drive

    arrays = {}
    for number, seed in enumerate(SEEDS):
        sweeps = window(make_drive(seed=seed, num_sweeps=SWEEPS), SWEEPS - 2, SWEEPS - 2)
        for step, sweep in enumerate((sweeps.pc1, sweeps.pc0, *sweeps.pch)):
            for field in fields(Sweep):
                arrays[f"{number}/{step}/{field.name}"] = np.asarray(getattr(sweep, field.name))
    return arrays


def read_streets(arrays: Dict[str, np.ndarray]) -> List[Window]:
    """The windows of `make_streets`."""
    windows = []
    for number in range(len(SEEDS)):
        sweeps = []
        for step in range(SWEEPS):
            points, is_ground, pose, time_ns = (arrays[f"{number}/{step}/{field.name}"] for field in fields(Sweep))
            sweeps.append(Sweep(points, is_ground, pose, int(time_ns)))
        windows.append(Window(sweeps[1], sweeps[0], tuple(sweeps[2:])))
    return windows


def windows_for(config: Config, number: int) -> List[Window]:
    """Different windows with the history that a config takes."""
    return [trim_history(sweeps, config) for sweeps in STREETS[:number]]


def on_device(sweeps: Window, device: str) -> Window:
    """The points already uploaded."""

    def uploaded(sweep: Sweep) -> Sweep:
        points, is_ground = (torch.as_tensor(np.asarray(x)).to(device) for x in (sweep.points, sweep.is_ground))
        return replace(sweep, points=points, is_ground=is_ground)

    return Window(uploaded(sweeps.pc0), uploaded(sweeps.pc1), tuple(map(uploaded, sweeps.pch)))


def check_bits(device: str) -> Rows:
    """GPU against CPU, every variant."""
    rows = []
    for name, (overrides, number) in VARIANTS.items():
        config = make_config("paper", **overrides)
        windows = windows_for(config, number)
        there, here = (make_model(config, where)(windows) for where in (device, "cpu"))
        rows.append({"variant": name, **compare(there, here), **rounding(windows, config, device)})
    return rows


def compare(there: Sequence[FlowResult], here: Sequence[FlowResult]) -> Dict[str, Any]:
    """Rows that differ in each field, the largest difference of the floats, and the verdict."""
    row: Dict[str, Any] = {"points": sum(len(result.flow) for result in here)}
    largest = 0.0
    for field in fields(FlowResult):
        count = 0
        for a, b in zip(there, here):
            x, y = getattr(a, field.name), getattr(b, field.name)
            if y is None:  # only the proof has a confidence
                continue
            x = x.cpu()
            differs = x != y
            count += int(differs.flatten(1).any(1).sum() if differs.dim() > 1 else differs.sum())
            if x.is_floating_point() and x.numel():
                largest = max(largest, float((x - y).abs().max()))
        row[field.name] = count
    row["largest_difference"] = largest
    row["same"] = all(row[field] == 0 for field in EXACT) and largest <= FLOAT_TOLERANCE
    return row


def rounding(windows: Sequence[Window], config: Config, device: str) -> Dict[str, int]:
    """Points that rounding moves: in or out of the region, to another pixel (finest scale, before any warp)."""
    lower, upper = config.point_cloud_range[:3], config.point_cloud_range[3:]
    grid = Grid(config.pixel_sizes[-1], lower, upper)
    there, here = (make_batch(windows, config, grid, where) for where in (device, "cpu"))
    if there.positions.shape != here.positions.shape:  # a point of another sweep is in here and out there
        return {"other_region": -1, "other_pixel": -1, "other_position": -1}
    inside = int((there.takes_part.cpu() != here.takes_part).sum())
    both = here.takes_part & there.takes_part.cpu()  # positions of others mean nothing
    moved = (there.positions.cpu() != here.positions).any(0) & both
    pixel = (grid.pixel(there.positions).cpu() != grid.pixel(here.positions)) & both
    return {"other_region": inside, "other_pixel": int(pixel.sum()), "other_position": int(moved.sum())}


def run_tests(_: str) -> Rows:
    """`pytest -m cuda` over the files that have such tests."""
    files = [file for file in sorted((ROOT / "tests").glob("test_*.py")) if "pytest.mark.cuda" in file.read_text()]
    command = [sys.executable, "-m", "pytest", "-v", "-m", "cuda", "--continue-on-collection-errors", "-rfE"]
    try:
        done = subprocess.run(
            [*command, *map(str, files)], cwd=str(ROOT), capture_output=True, text=True, timeout=TEST_SECONDS
        )
    except subprocess.TimeoutExpired:
        return [{"tests": f"not done after {TEST_SECONDS:g} s", "status": -1}]
    lines = (done.stdout or done.stderr).strip().splitlines()
    rows = [{"tests": line.strip(" ="), "status": done.returncode} for line in lines[-1:]]
    return rows + [{"tests": line} for line in lines if line.startswith(("FAILED", "ERROR"))]


def measure_speed(device: str) -> Rows:
    """Milliseconds of one window, windows per second of batches; from NumPy arrays, and from tensors on the device."""
    rows = []
    batches = (1, 8, 32) if device == "cuda" else (1, 2)
    for name, config in SPEED.items():
        host = windows_for(config, 1)
        for kind, windows in (("arrays", host), (device, [on_device(w, device) for w in host])):
            for size, figures in measure_throughput(windows, config, batches, 30, device).items():
                row = {"work": name, "input": kind, "batch": size, "ms": 1000 * figures["median_s"]}
                rows.append({**row, "windows/s": figures["windows_per_s"], "runs": figures["runs"]})
    return rows


def count_launches(device: str) -> Rows:
    """Kernel launches, waits and copies of one warm window, by the profiler; and what `count_work` counts."""
    rows = []
    for name, config in SPEED.items():
        windows, model = windows_for(config, 1), make_model(config, device)
        work = count_work(model, windows)
        row: Dict[str, Any] = {"work": name, "operations": work.operations, "waits": work.waits}
        row["uploads"] = work.uploads
        if device == "cuda":
            row.update(_by_profiler(lambda m=model, w=windows: m(w)))  # type: ignore[misc]
            row["places"] = _waiting_lines(lambda m=model, w=windows: m(w))  # type: ignore[misc]
        rows.append(row)
    return rows


def _by_profiler(run: Callable[[], Any]) -> Dict[str, Any]:
    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        run()
        torch.cuda.synchronize()
    events = profiler.events() or []
    on_gpu = [e for e in events if e.device_type == torch.autograd.DeviceType.CUDA and e.name not in ANNOTATIONS]
    return {
        "launches": sum(event.name.startswith(LAUNCHES) for event in events),
        "syncs": sum(event.name.startswith(WAITS) for event in events) - 1,  # the last one is ours
        "copies": sum(event.name.startswith(COPIES) for event in events),
        "gpu_ms": sum(event.time_range.elapsed_us() for event in on_gpu) / 1000,
    }


def _waiting_lines(run: Callable[[], Any]) -> Dict[str, int]:
    """Lines of Python at which torch says that the host waits, and how often."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            run()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    places = Counter(f"{Path(w.filename).name}:{w.lineno}" for w in caught if "synchron" in str(w.message))
    return dict(places.most_common())


def measure_memory(device: str) -> Rows:
    """Most memory at once, with and without a limit; the limit must change no bit."""
    rows = []
    size = 32 if device == "cuda" else 2
    for name, config in SPEED.items():
        batch = windows_for(config, 1) * size
        free = make_model(config, device)(batch)
        of_results = sum(value.nbytes for r in free for value in r.numpy().values())
        for limit in (None, 1_000_000_000, 200_000_000):
            model = make_model(config.replace(max_memory=limit), device)
            same = compare(model(batch), [result.to("cpu") for result in free])
            bits = all(same[field.name] == 0 for field in fields(FlowResult))
            _, peak = count_allocations(lambda m=model, b=batch: m(b))  # type: ignore[misc]
            row = {"work": name, "batch": size, "max_memory_MB": limit and limit / 1e6, "peak_MB": peak / 1e6}
            rows.append({**row, "results_MB": of_results / 1e6, "same_bits": bits})
    return rows


PARTS: Dict[str, Callable[[str], Rows]] = {
    "bits": check_bits,
    "speed": measure_speed,
    "launches": count_launches,
    "memory": measure_memory,
    "tests": run_tests,
}


def show(title: str, rows: Rows) -> None:
    """Markdown."""
    keys = list(dict.fromkeys(key for row in rows for key in row if key != "places"))
    print(f"\n## {title}\n\n| " + " | ".join(keys) + " |\n" + "|---" * len(keys) + "|")
    for row in rows:
        print("| " + " | ".join(_cell(row.get(key, "")) for key in keys) + " |")
    for row in rows:
        if "places" in row:
            print(f"\nwaits of {row['work']}: " + ", ".join(f"{place} x{n}" for place, n in row["places"].items()))
    sys.stdout.flush()


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) and abs(value) < 1e4 else str(value)


def main() -> None:
    """Run the parts, print tables, write one JSON; the status is 1 if bits differ or a test failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("outputs/gpu_check.json"))
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu", choices=("cuda", "cpu"))
    parser.add_argument("--skip", nargs="*", default=[], choices=list(PARTS))
    parser.add_argument("--windows", type=Path, help="file of the simulated windows, made if it is not there")
    options = parser.parse_args()
    started = time.monotonic()
    if options.windows and options.windows.exists():
        arrays = dict(np.load(options.windows))
    else:
        arrays = make_streets()
        if options.windows:
            np.savez_compressed(options.windows, **arrays)  # type: ignore[arg-type]
    STREETS.extend(read_streets(arrays))
    report: Dict[str, Any] = {"machine": describe_machine(torch.get_num_threads(), torch.device(options.device))}
    print(json.dumps(report["machine"]))
    if options.device == "cpu":
        report["note"] = "no GPU: compared CPU with CPU"
        print(report["note"])
    for name, part in PARTS.items():
        spent = time.monotonic() - started
        room = BUDGET_SECONDS - spent - (TEST_SECONDS if name == "tests" else 0)
        if name in options.skip or room < 0:
            report[name] = "skipped" if name in options.skip else f"left out: {spent:.0f} s are over"
            print(f"\n## {name}: {report[name]}")
            continue
        try:
            report[name] = part(options.device)
            show(name, report[name])
        except Exception as error:  # the other parts are worth having
            report[name] = f"{type(error).__name__}: {error}"
            print(f"\n## {name}: {report[name]}")
        report[f"{name}_seconds"] = round(time.monotonic() - started - spent, 1)
        options.output.parent.mkdir(parents=True, exist_ok=True)
        options.output.write_text(json.dumps(report, indent=1) + "\n")
    print(f"\n{time.monotonic() - started:.0f} s, written to {options.output}")
    differ = [row["variant"] for row in report["bits"] if not row["same"]] if isinstance(report["bits"], list) else []
    failed = isinstance(report["tests"], list) and report["tests"][0].get("status") not in (0, 5)
    broken = [name for name in PARTS if isinstance(report[name], str) and "Error" in report[name]]
    if differ or failed or broken:
        raise SystemExit(f"differ: {differ}; tests failed: {failed}; parts that stopped: {broken}")


if __name__ == "__main__":
    main()
