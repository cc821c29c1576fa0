"""Memory, open files, threads and objects of one process over many windows: they must not grow. Linux only.

  python scripts/leaks.py door --preset paper       10,000 windows of small sweeps through `estimate_flow`
  python scripts/leaks.py door --preset default
  python scripts/leaks.py files                     open a log, read, estimate, write, read again, score; broken logs
  python scripts/leaks.py worker --windows 900      a fleet's worker, 300 logs of 3 windows

Prints a JSON line: growth per window after the first fifth (least squares), medians of the second and the last fifth.
Ends with status 1 if something grew, see `BOUNDS`.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import shutil
import statistics
import sys
import tempfile
import threading
import time
import warnings
from functools import _lru_cache_wrapper
from pathlib import Path
from typing import Any, Dict, Iterator, List, Tuple

import numpy as np
import torch

from cflow_torch import CFlowError, estimate_flow, make_config, make_model
from cflow_torch.data.arrays import ArraysLog, write_array_log
from cflow_torch.data.flow_file import read_flow, write_flow
from cflow_torch.data.log import FlowLabels, RecentSweeps, window
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics
from cflow_torch.fleet.job import Done, Failed, Job, Unit
from cflow_torch.fleet.work import Worker
from cflow_torch.types import Sweep

# Growth over a run that counts as none: slope times windows. The allocator moves some megabytes by itself.
BOUNDS = {"rss_bytes": 10e6, "files": 0.5, "threads": 0.5, "objects": 100.0, "tensors": 10.0, "cached": 10.0}
SAMPLES = 100
RANGE = (-12.8, -12.8, -3.0, 12.8, 12.8, 3.0)
KEPT_LOGS, LOG_SWEEPS = 20, 4


def make_sweep(rng: np.random.Generator, index: int) -> Sweep:
    """A wall, and a few boxes that move by themselves; 100 to 4,000 points."""
    count = int(rng.integers(100, 4000))
    wall = rng.uniform((-12, 9, -1), (12, 9.3, 2), (count // 2, 3))
    number = rng.integers(0, 5, count - count // 2)
    boxes = rng.uniform(-0.5, 0.5, (len(number), 3)) * (4, 2, 1.5) + np.array([-8, -6, 0]) + number[:, None] * (4, 2, 0)
    boxes[:, 0] += 0.3 * index * number
    return Sweep(np.concatenate([wall, boxes]).astype(np.float32), None, np.eye(4), 100_000_000 * index)


class Drive:
    """A log of small sweeps."""

    def __init__(self, seed: int, num_sweeps: int = LOG_SWEEPS) -> None:
        rng = np.random.default_rng(seed)
        self.log_id, self.timestamps = f"log-{seed:04d}", [100_000_000 * index for index in range(num_sweeps)]
        self._sweeps = [make_sweep(rng, index) for index in range(num_sweeps)]

    def sweep(self, index: int) -> Sweep:
        return self._sweeps[index]

    def labels(self, index: int) -> FlowLabels:
        count = len(self._sweeps[index].points)
        return FlowLabels(np.zeros((count, 3), np.float32), np.zeros(count, np.uint8), np.ones(count, bool))


def door(preset: str) -> Iterator[None]:
    """New clouds through the in-process door, for ever."""
    rng = np.random.default_rng(0)
    settings: Dict[str, Any] = {} if preset == "keypoints" else {"point_cloud_range": RANGE}
    while True:
        first, second = make_sweep(rng, 0), make_sweep(rng, 1)
        masks = [np.zeros(len(sweep.points), bool) for sweep in (first, second)]
        estimate_flow(first.points, second.points, gm0=masks[0], gm1=masks[1], preset=preset, **settings)
        yield


def write_logs(root: Path, count: int) -> List[Path]:
    """So many folders of clouds, the first ones under many names."""
    kept = [write_array_log(Drive(seed), root) for seed in range(min(KEPT_LOGS, count))]  # type: ignore[arg-type]
    more = [root / f"log-{number:04d}" for number in range(len(kept), count)]
    for number, folder in enumerate(more):
        shutil.copytree(kept[number % len(kept)], folder)
    return [*kept, *more]


def files(preset: str, scratch: Path) -> Iterator[None]:
    """Logs opened, read, estimated, written, read again and scored, for ever; every tenth time one that is broken."""
    folders, model = write_logs(scratch / "logs", KEPT_LOGS), make_model(make_config(preset, point_cloud_range=RANGE))
    broken = scratch / "broken"
    shutil.copytree(folders[0], broken)
    (broken / "points" / "000001.npy").write_bytes(b"\x93NUMPY half")
    number = 0
    while True:
        folder = folders[number % KEPT_LOGS]
        metrics, truth = SceneFlowMetrics(), Drive(number % KEPT_LOGS)
        log = RecentSweeps(ArraysLog(folder), 2)
        for index in range(LOG_SWEEPS - 1):
            sweeps = window(log, index)
            (result,) = model([sweeps])
            file = scratch / "flow" / log.log_id / f"{index}.feather"
            write_flow(file, result)
            metrics.update(EvalFrame.from_result(sweeps, read_flow(file), truth.labels(index)))
            yield
        metrics.compute()
        number += 1
        if number % 10 == 0:
            for wrong in (lambda: window(ArraysLog(broken), 0), lambda: read_flow(broken / "points" / "000001.npy")):
                try:
                    wrong()
                except CFlowError:
                    continue
                raise SystemExit("a broken file was read")


def worker(preset: str, scratch: Path, num_windows: int) -> Iterator[None]:
    """One worker of a fleet, log after log."""
    config = make_config(preset, point_cloud_range=RANGE)
    job = Job(config, "0" * 64, "arrays", {}, str(scratch / "flow"), batch=2, check=False)
    hand = Worker(job, "cpu")
    for number, folder in enumerate(write_logs(scratch / "logs", -(-num_windows // (LOG_SWEEPS - 1)))):
        for event in hand.run(Unit(number, folder)):
            if isinstance(event, Failed):
                raise SystemExit(f"{event.name}: {event.message}")
            if isinstance(event, Done):
                yield
    hand.close()


def look() -> Dict[str, int]:
    """What this process holds now."""
    gc.collect()
    objects = gc.get_objects()
    held = {
        "files": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "objects": len(objects),
        "tensors": sum(type(one) is torch.Tensor for one in objects),
        "cached": sum(one.cache_info().currsize for one in objects if type(one) is _lru_cache_wrapper),
    }
    del objects
    return {**held, "rss_bytes": int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")}


def watch(windows: Iterator[None], num_windows: int, seconds: float) -> List[Tuple[int, Dict[str, int]]]:
    """What the process held after so many windows, again and again; it may end early."""
    end = time.monotonic() + seconds
    seen: List[Tuple[int, Dict[str, int]]] = []
    for number in range(1, num_windows + 1):
        next(windows)
        if number % max(1, num_windows // SAMPLES) == 0:
            held = look()
            held["objects"] -= len(seen)  # our own
            seen.append((number, held))
            if time.monotonic() > end:
                break
    return seen


def growth(seen: List[Tuple[int, Dict[str, int]]]) -> Dict[str, Dict[str, float]]:
    """Of each count: slope per window after the first fifth, medians of the second and the last fifth."""
    fifth = len(seen) // 5
    numbers = np.array([number for number, _ in seen[fifth:]], np.float64)
    found = {}
    for name in BOUNDS:
        values = [held[name] for _, held in seen]
        slope = float(np.polyfit(numbers, np.array(values[fifth:], np.float64), 1)[0])
        early, late = (statistics.median(part) for part in (values[fifth : 2 * fifth], values[-fifth:]))
        found[name] = {"per_window": slope, "early": early, "late": late}
    return found


def main() -> None:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["door", "files", "worker"])
    parser.add_argument("--preset", default="paper")
    parser.add_argument("--windows", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="then it ends with the windows it has done")
    given = parser.parse_args()
    warnings.simplefilter("error", ResourceWarning)
    torch.set_num_threads(1)
    unclosed: List[str] = []
    sys.unraisablehook = lambda found: unclosed.append(str(found.exc_value))  # a file that only the collector closes
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as scratch:
        windows = {
            "door": lambda: door(given.preset),
            "files": lambda: files(given.preset, Path(scratch)),
            "worker": lambda: worker(given.preset, Path(scratch), given.windows),
        }[given.what]()
        seen = watch(windows, given.windows, 60 * given.minutes)
    found = growth(seen)
    about = {"what": given.what, "preset": given.preset, "windows": seen[-1][0]}
    grew = [name for name, bound in BOUNDS.items() if found[name]["per_window"] * seen[-1][0] > bound]
    shown = {name: {key: float(f"{value:.4g}") for key, value in figures.items()} for name, figures in found.items()}
    seconds = round(time.perf_counter() - start)
    print(json.dumps({**about, "seconds": seconds, **shown, "grew": grew, "unclosed": unclosed[:5]}))
    if grew or unclosed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
