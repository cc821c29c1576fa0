"""Throughput of `cflow flow` against reading, computing and writing in sequence, and its memory over many windows.

  python scripts/bench_fleet.py throughput             ratios, a JSON line per way
  python scripts/bench_fleet.py memory --plot docs/fleet_memory.png

Both simulate street drives of 100,000 points a sweep first (once; kept in --folder) and give each several names.
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
from typing import Any, Dict, List, Sequence, Tuple

import torch

from cflow_torch import make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import RecentSweeps, window
from cflow_torch.fleet.job import Done, Failed, Job, Opened, Unit, split
from cflow_torch.fleet.local import run_local
from cflow_torch.fleet.machine import CPU_BATCH, Layout, usable_cores
from cflow_torch.simulator.benchmark import benchmark_logs

PAIRS, DRIVES = 40, 5
_HELPER_MB = 50  # smaller processes are Python's own, which watch over the workers


def make_fleet(folder: Path, num_windows: int) -> List[Path]:
    """Logs with so many pairs together: a few drives under many names (hard links, no more room on the disk)."""
    drives = benchmark_logs(folder / "drives", "av2", range(900, 900 + DRIVES), PAIRS + 1)
    root = folder / f"fleet-{num_windows}"
    root.mkdir(parents=True, exist_ok=True)
    for number in range(num_windows // PAIRS):
        if not (root / f"log-{number:04d}").is_dir():
            shutil.copytree(drives[number % DRIVES], root / f"log-{number:04d}", copy_function=os.link)
    return sorted(root.iterdir())


def in_sequence(logs: Sequence[Path], preset: str, output: Path, threads: int) -> Tuple[int, float]:
    """One window after the other: read, compute, write. Frames and seconds, without start-up."""
    torch.set_num_threads(threads)
    config = make_config(preset)
    model = make_model(config, "cpu")
    model([window(AV2Log(logs[0]), 0, config.num_history)])
    count, start = 0, time.perf_counter()
    for folder in logs:
        log = RecentSweeps(AV2Log(folder), config.num_history + 2)
        for index in range(len(log.timestamps) - 1):
            (result,) = model([window(log, index, config.num_history)])
            write_flow(output / folder.name / f"{log.timestamps[index]}.feather", result)
            count += 1
    return count, time.perf_counter() - start


def by_engine(logs: Sequence[Path], preset: str, output: Path, layout: Layout) -> Tuple[int, float]:
    """The engine: frames and seconds from the first log's opening to the end, without the start of processes."""
    job = Job(make_config(preset), "0" * 64, "av2", {}, str(output), batch=layout.batch, check=False)
    units = split([Unit(0, folder) for folder in logs], len(layout.devices))
    count, start = 0, None
    for event in run_local(job, units, layout, lambda: False):
        if isinstance(event, Opened) and start is None:
            start = time.perf_counter()
        if isinstance(event, Failed):
            raise SystemExit(f"{event.name}: {event.message}")
        count += isinstance(event, Done)
    assert start is not None
    return count, time.perf_counter() - start


def throughput(folder: Path, num_windows: int, preset: str, repeats: int, batch: int) -> None:
    """Frames per second of every way in turn, and ratios of the same round."""
    logs, cores = make_fleet(folder, num_windows), usable_cores({})
    layouts = {
        "1 worker, all threads": Layout(("cpu",), cores, batch),
        "worker per core": Layout(("cpu",) * cores, 1, batch),
    }
    rates: Dict[str, List[float]] = {name: [] for name in ["in sequence", *layouts]}
    for _ in range(repeats):
        for name in rates:
            with tempfile.TemporaryDirectory(dir=folder) as scratch:
                if name == "in sequence":
                    count, seconds = in_sequence(logs, preset, Path(scratch), cores)
                else:
                    torch.set_num_threads(layouts[name].threads)
                    count, seconds = by_engine(logs, preset, Path(scratch), layouts[name])
            assert count == num_windows, f"{name}: {count} of {num_windows}"
            rates[name].append(count / seconds)
    for name, values in rates.items():
        ratios = [value / base for value, base in zip(values, rates["in sequence"])]
        about: Dict[str, Any] = {
            "preset": preset,
            "batch": batch,
            "way": name,
            "frames_per_s": round(statistics.median(values), 2),
        }
        about["of in sequence"] = round(statistics.median(ratios), 3)
        print(json.dumps({**about, "rounds": [round(ratio, 3) for ratio in ratios]}), flush=True)


def memory(folder: Path, num_windows: int, preset: str, plot: str) -> None:
    """Resident memory of a run's processes as its frames are done."""
    logs = make_fleet(folder, num_windows)
    output = folder / "memory-output"
    shutil.rmtree(output, ignore_errors=True)
    arguments = ["data=av2", f"data.root={logs[0].parent}", f"output={output}", f"model={preset}", "data.check=false"]
    process = subprocess.Popen([sys.executable, "-m", "cflow_torch.cli.main", "flow", *arguments])
    seen: List[Tuple[int, Dict[int, float]]] = []
    while process.poll() is None:
        frames = sum(1 for _ in output.glob("*/*.feather"))
        seen.append((frames, {pid: mb for pid, mb in _resident_mb(process.pid).items() if mb > _HELPER_MB}))
        time.sleep(0.5)
    shutil.rmtree(output)
    if process.returncode != 0:
        raise SystemExit(process.returncode)
    workers = sorted({pid for frames, sizes in seen for pid in sizes if frames > 0 and pid != process.pid})
    series = {f"worker {n + 1}": [(f, s[pid]) for f, s in seen if pid in s] for n, pid in enumerate(workers)}
    series["parent"] = [(f, s[process.pid]) for f, s in seen if process.pid in s]
    for name, values in series.items():
        parts = [[mb for f, mb in values if low <= f / num_windows < high] for low, high in ((0.1, 0.3), (0.8, 1.0))]
        early, late = (statistics.median(part) for part in parts)
        most = max(mb for _, mb in values)
        about = {"process": name, "MB at 10-30 %": round(early), "MB at 80-100 %": round(late), "most": round(most)}
        print(json.dumps({"preset": preset, "windows": num_windows, **about}))
    if plot:
        _plot(series, preset, plot)


def _resident_mb(parent: int) -> Dict[int, float]:
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


def _plot(series: Dict[str, List[Tuple[int, float]]], preset: str, file: str) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 3.2), constrained_layout=True)
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
    parser.add_argument("--folder", type=Path, default=Path("outputs/bench_fleet"), help="drives and scratch")
    parser.add_argument("--windows", type=int, help=f"multiple of {PAIRS}; default 200 and 2000")
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--batch", type=int, default=CPU_BATCH)
    parser.add_argument("--plot", default="", help="PNG of the memory")
    given = parser.parse_args()
    if given.what == "throughput":
        throughput(given.folder, given.windows or 5 * PAIRS, given.preset, given.repeats, given.batch)
    else:
        memory(given.folder, given.windows or 50 * PAIRS, given.preset, given.plot)


if __name__ == "__main__":
    main()
