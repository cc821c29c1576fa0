#!/usr/bin/env python3
"""Compare the speed with that of an earlier version: medians of paired ratios of CPU time, one thread each.

  git worktree add ../earlier 136deedc                                       version 0.4.0
  python scripts/benchmarks/earlier_speed.py ../earlier LOG ... --repeats 20

A process of each version opens the logs and waits. We ask them for one window in turn, so that a slow spell of the
machine hits both, and divide neighbouring times. `--keep-memory` lets this version keep freed memory, as the commands
do. Peak memory is that of the process: its resident memory at most, less what it had before the first window.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any, Iterator

ROOT = Path(__file__).resolve().parents[2]
# What is compared: a preset and its settings. The last one answers for live use: this version's `live` against the
# earlier version's `default`.
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "`default`, h = 4": ("default", {}),
    "`default`, pair": ("default", {"num_history": 0}),
    "`offline`": ("offline", {}),
    "`paper`, h = 4": ("paper", {"num_history": 4}),
    "`keypoints`, pair": ("keypoints", {}),
}
LIVE = "`live` / `default`, h = 4"


def serve(paths: list[str], keep_memory: bool) -> None:
    """Answer each line, "number of a log, case", with the CPU seconds of its middle window and the memory so far."""
    import torch

    from cflow_torch import make_config, make_model
    from cflow_torch.data.catalog import find_sources, open_log, recognise
    from cflow_torch.data.log import window

    if keep_memory:
        from cflow_torch.windows.memory import keep_freed_memory

        keep_freed_memory()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    names = map(recognise, paths)
    logs = [open_log(name, find_sources(name, path)[0], check=False) for name, path in zip(names, paths)]
    calls: dict[str, Any] = {}
    print("ready", flush=True)
    for line in sys.stdin:
        asked = line.strip()
        if asked not in calls:
            number, preset, *settings = asked.split("|")
            config = make_config(preset, **{name: int(value) for name, value in (pair.split("=") for pair in settings)})
            log = logs[int(number)]
            index = min(len(log.timestamps) // 2, len(log.timestamps) - 2 - config.num_future)
            sweeps = window(log, index, config.num_history, config.num_future)
            calls[asked] = (make_model(config, "cpu"), sweeps, _peak())
            calls[asked][0]([sweeps])
        model, sweeps, before = calls[asked]
        start = time.thread_time()
        model([sweeps])
        print(time.thread_time() - start, (_peak() - before) / 1024, flush=True)


def _peak() -> int:
    """KiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


class Version:
    """A process with one version of the package."""

    def __init__(self, root: Path, paths: list[str], keep_memory: bool) -> None:
        command = [sys.executable, __file__, str(root), *paths, "--serve"]
        self._process = subprocess.Popen(
            command + (["--keep-memory"] if keep_memory else []),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"},
            cwd=root,
            text=True,
        )
        assert self._process.stdout is not None and self._process.stdin is not None
        self._answers, self._questions = self._process.stdout, self._process.stdin
        while self._answers.readline().strip() != "ready":
            if self._process.poll() is not None:
                raise SystemExit(f"{root} cannot open {', '.join(paths)}")

    def ask(self, log: int, preset: str, settings: dict[str, Any]) -> tuple[float, float]:
        """Seconds of a window, and MiB so far."""
        words = [str(log), preset, *(f"{name}={value}" for name, value in settings.items())]
        self._questions.write("|".join(words) + "\n")
        self._questions.flush()
        seconds, memory = self._answers.readline().split()
        return float(seconds), float(memory)


def compare(given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """A row for each log and case."""
    paths = [str(Path(path).resolve()) for path in given.logs]
    for number, path in enumerate(paths):
        for name, (preset, settings) in [*CASES.items(), (LIVE, ("live", {}))]:
            # New processes for each case, because peak memory never falls.
            earlier, now = Version(given.earlier, paths, False), Version(ROOT, paths, given.keep_memory)
            earlier_preset = "default" if preset == "live" else preset
            pairs = [
                (earlier.ask(number, earlier_preset, settings), now.ask(number, preset, settings))
                for _ in range(given.repeats + 1)
            ]
            old, new = ([pair[side][0] for pair in pairs[1:]] for side in (0, 1))
            yield {
                "log": Path(path).name,
                "what": name,
                "time now / earlier": statistics.median(b / a for a, b in zip(old, new)),
                "ms earlier": round(1000 * statistics.median(old)),
                "ms now": round(1000 * statistics.median(new)),
                "slowest / median": max(new) / statistics.median(new),
                "MiB earlier": round(pairs[-1][0][1]),
                "MiB now": round(pairs[-1][1][1]),
            }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("earlier", type=Path, help="a checkout of the earlier version")
    parser.add_argument("logs", nargs="+", help="logs of any known format")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--keep-memory", action="store_true")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.serve:
        serve(given.logs, given.keep_memory)
        return
    from table import markdown

    print(markdown(list(compare(given))))


if __name__ == "__main__":
    main()
