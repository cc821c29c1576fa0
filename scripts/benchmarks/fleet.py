#!/usr/bin/env python3
"""Throughput of `cflow flow` against reading, computing and writing in sequence, and its memory over many windows.

  python scripts/benchmarks/fleet.py throughput             ratios, a JSON line per way
  python scripts/benchmarks/fleet.py memory --plot docs/fleet_memory.png

Both simulate street drives of 100,000 points a sweep first (once; kept in --folder) and give each several names. Rates
count from the first flow file to the last, so without the start of processes. `memory` needs Linux.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Dict, List, Sequence, Tuple

import torch

from cflow_torch import make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import RecentSweeps, window
from cflow_torch.simulator.benchmark import benchmark_logs

PAIRS, DRIVES = 40, 5
HELPER_MB = 50  # smaller processes are Python's own, which watch over the workers


def make_fleet(folder: Path, num_windows: int) -> List[Path]:
    """Logs with so many pairs together: a few drives under many names (hard links, no more room on the disk)."""
    drives = benchmark_logs(folder / "drives", "av2", range(900, 900 + DRIVES), PAIRS + 1)
    root = folder / f"fleet-{num_windows}"
    root.mkdir(parents=True, exist_ok=True)
    for number in range(num_windows // PAIRS):
        if not (root / f"log-{number:04d}").is_dir():
            shutil.copytree(drives[number % DRIVES], root / f"log-{number:04d}", copy_function=os.link)
    return sorted(root.iterdir())


def in_sequence(logs: Sequence[Path], preset: str, output: Path) -> None:
    """One window after the other: read, compute, write."""
    config = make_config(preset)
    model = make_model(config, "cpu")
    for folder in logs:
        log = RecentSweeps(AV2Log(folder), config.num_history + 2)
        for index in range(len(log.timestamps) - 1):
            (result,) = model([window(log, index, config.num_history)])
            write_flow(output / folder.name / f"{log.timestamps[index]}.feather", result)


def start_fleet(logs: Sequence[Path], preset: str, output: Path, *settings: str) -> subprocess.Popen:
    """`cflow flow` of the logs."""
    call = [sys.executable, "-m", "cflow_torch.cli.main", "flow", "data=av2", f"data.root={logs[0].parent}"]
    call += [f"output={output}", f"model={preset}", "data.check=false", *settings]
    return subprocess.Popen(call, stdout=subprocess.DEVNULL)


def rate(output: Path, num_windows: int) -> float:
    """Windows per second from the first flow file to the last."""
    written = sorted(file.stat().st_mtime_ns for file in output.glob("*/*.feather"))
    if len(written) != num_windows:
        raise SystemExit(f"{len(written)} of {num_windows} flow files")
    return 1e9 * (len(written) - 1) / (written[-1] - written[0])


def throughput(folder: Path, num_windows: int, preset: str, repeats: int) -> None:
    """Windows per second of every way in turn, and ratios of the same round."""
    logs, cores = make_fleet(folder, num_windows), os.cpu_count() or 1
    ways = {"in sequence": (), "1 worker": (1, cores), "a worker per core": (cores, 1)}
    rates: Dict[str, List[float]] = {name: [] for name in ways}
    torch.set_num_threads(cores)
    for _ in range(repeats):
        for name, layout in ways.items():
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                if layout:
                    settings = [f"engine.workers={layout[0]}", f"engine.threads={layout[1]}"]
                    if start_fleet(logs, preset, Path(scratch, "flow"), *settings).wait():
                        raise SystemExit(f"{name} failed")
                else:
                    in_sequence(logs, preset, Path(scratch, "flow"))
                rates[name].append(rate(Path(scratch, "flow"), num_windows))
    for name, values in rates.items():
        ratios = [value / base for value, base in zip(values, rates["in sequence"])]
        figures = {"windows_per_s": statistics.median(values), "of in sequence": statistics.median(ratios)}
        about = {key: round(value, 3) for key, value in figures.items()}
        print(json.dumps({"preset": preset, "way": name, **about, "rounds": [round(ratio, 3) for ratio in ratios]}))


def memory(folder: Path, num_windows: int, preset: str, plot: str) -> None:
    """Resident memory of a run's processes as its windows are done."""
    logs, output = make_fleet(folder, num_windows), folder / "memory-output"
    shutil.rmtree(output, ignore_errors=True)
    process = start_fleet(logs, preset, output)
    seen: List[Tuple[int, Dict[int, float]]] = []
    while process.poll() is None:
        done = sum(1 for _ in output.glob("*/*.feather"))
        seen.append((done, {pid: mb for pid, mb in resident_mb(process.pid).items() if mb > HELPER_MB}))
        time.sleep(0.5)
    shutil.rmtree(output)
    if process.returncode != 0:
        raise SystemExit(process.returncode)
    workers = sorted({pid for done, sizes in seen for pid in sizes if done > 0 and pid != process.pid})
    series = {f"worker {n + 1}": [(done, s[pid]) for done, s in seen if pid in s] for n, pid in enumerate(workers)}
    series["parent"] = [(done, s[process.pid]) for done, s in seen if process.pid in s]
    for name, values in series.items():
        about = {"preset": preset, "windows": num_windows, "process": name}
        for low, high in ((0.1, 0.3), (0.8, 1.0)):
            part = [mb for done, mb in values if low <= done / num_windows < high]
            about[f"MB at {low:.0%}-{high:.0%}"] = round(statistics.median(part)) if part else None
        print(json.dumps({**about, "most": round(max(mb for _, mb in values))}))
    if plot:
        draw(series, preset, plot)


def resident_mb(parent: int) -> Dict[int, float]:
    """Resident megabytes of a process and those below it, by process (Linux)."""
    sizes: Dict[int, float] = {}
    waiting = [parent]
    while waiting:
        pid = waiting.pop()
        try:
            lines = Path(f"/proc/{pid}/status").read_text().splitlines()
            waiting += [int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
        except (FileNotFoundError, ProcessLookupError):
            continue
        sizes[pid] = next((int(line.split()[1]) / 1e3 for line in lines if line.startswith("VmRSS")), 0.0)
    return sizes


def draw(series: Dict[str, List[Tuple[int, float]]], preset: str, file: str) -> None:
    """A line per process."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    for name, values in series.items():
        axes.plot(*zip(*values), label=name, linewidth=1.5)
    axes.set(xlabel="windows done", ylabel="resident memory, MB", title=f"cflow flow, preset {preset}", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(file, dpi=110)


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["throughput", "memory"])
    parser.add_argument("--folder", type=Path, default=Path("outputs/benchmarks/fleet"), help="drives and scratch")
    parser.add_argument("--windows", type=int, help=f"multiple of {PAIRS}; default 200 and 2000")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--plot", default="", help="PNG of the memory")
    given = parser.parse_args()
    if given.what == "throughput":
        throughput(given.folder, given.windows or 5 * PAIRS, given.preset, given.repeats)
    else:
        memory(given.folder, given.windows or 50 * PAIRS, given.preset, given.plot)


if __name__ == "__main__":
    main()
