#!/usr/bin/env python3
"""How time grows: with points in the same pixels, with occupied area, with windows in a batch.

  OMP_NUM_THREADS=1 python scripts/benchmarks/growth.py                 docs/benchmarks/growth.png and growth.json
  OMP_NUM_THREADS=1 python scripts/benchmarks/growth.py --repeats 3 --folder outputs/growth

One simulated street window, +-35 m, two settings. Points: every point given k times. Area: k copies of the street side
by side, the region as long as they are. Windows: a batch of k. Medians; one thread, unless --threads says otherwise.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, Callable, Dict, List, Tuple

import numpy as np
import torch

from cflow_torch import Config, Sweep, Window, make_config, make_model
from cflow_torch.cli.run import machine
from cflow_torch.data.log import window
from cflow_torch.simulator import make_drive
from cflow_torch.stages import StopWatch

SETTINGS: Dict[str, Config] = {
    "h = 0, 1 scale": make_config("paper"),
    "h = 4, 5 scales": make_config("paper", num_history=4, pixel_sizes=(0.8, 0.4, 0.3, 0.2, 0.1)),
}
HALF = 35.0  # m
POINTS, AREAS, BATCHES = (1, 2, 3, 4, 6, 8), (1, 2, 3, 4, 6, 8), (1, 2, 4, 8, 16, 32)
# The full configuration in large batches takes gigabytes.
LARGEST_BATCH = {"h = 0, 1 scale": 32, "h = 4, 5 scales": 8}
# Stages before any pixel is known, and after all are: they look at every point.
PER_POINT = ("compensate", "project", "spread")

Case = Tuple[Config, List[Window]]


def of_each_sweep(sweeps: Window, change: Callable[[Sweep], Sweep]) -> Window:
    """A window with every sweep changed."""
    return Window(change(sweeps.pc0), change(sweeps.pc1), tuple(map(change, sweeps.pch)))


def near(sweep: Sweep, T_ego1_ego: np.ndarray) -> Sweep:
    """Points of the tile that the region is, in the frame of t+1, ground left out: tiles must not overlap."""
    points = np.asarray(sweep.points, dtype=np.float64)[:, :3] @ T_ego1_ego[:3, :3].T + T_ego1_ego[:3, 3]
    inside = (np.abs(points[:, :2]) < HALF).all(1) & ~np.asarray(sweep.is_ground)
    return Sweep(points[inside])


def street(num_history: int) -> Window:
    """The window that everything is made of: no ground, no poses."""
    sweeps = window(make_drive(seed=7, num_sweeps=6), 4, num_history)
    to_t1 = np.linalg.inv(np.asarray(sweeps.pc1.pose))
    return of_each_sweep(sweeps, lambda sweep: near(sweep, to_t1 @ np.asarray(sweep.pose)))


def more_points(sweeps: Window, times: int) -> Window:
    """Every point `times` times."""
    return of_each_sweep(sweeps, lambda sweep: Sweep(np.repeat(np.asarray(sweep.points), times, axis=0)))


def more_area(sweeps: Window, times: int) -> Window:
    """`times` copies, each moved by the length of the region."""
    steps = [np.array([2 * HALF * i, 0.0, 0.0]) for i in range(times)]
    return of_each_sweep(sweeps, lambda sweep: Sweep(np.concatenate([np.asarray(sweep.points) + s for s in steps])))


def cases(config: Config, sweeps: Window, largest_batch: int) -> Dict[str, Dict[int, Case]]:
    """What is timed: panel -> factor -> settings and batch."""
    x0, y0, z0, x1, y1, z1 = config.point_cloud_range
    long = {k: config.replace(point_cloud_range=(x0, y0, z0, x1 + 2 * HALF * (k - 1), y1, z1)) for k in AREAS}
    return {
        "points": {k: (config, [more_points(sweeps, k)]) for k in POINTS},
        "area": {k: (long[k], [more_area(sweeps, k)]) for k in AREAS},
        "windows": {k: (config, [sweeps] * k) for k in BATCHES if k <= largest_batch},
    }


def measure(case: Case, repeats: int) -> Dict[str, Any]:
    """Median seconds of a batch and of its stages, see `StopWatch.report`; points, and clusters of the first window."""
    config, batch = case
    watch = StopWatch(make_model(config, "cpu"))
    for _ in range(1 + repeats):
        result = watch(batch)[0]
    points = sum(len(sweep.points) for w in batch for sweep in (w.pc0, w.pc1, *w.pch))
    return {**watch.report(), "points": points, "clusters": int(result.cluster_id.max()) + 1}


def measure_all(repeats: int) -> Dict[str, Any]:
    """Setting -> panel -> factor -> figures."""
    report: Dict[str, Any] = {}
    for name, config in SETTINGS.items():
        report[name] = {}
        for panel, of_factor in cases(config, street(config.num_history), LARGEST_BATCH[name]).items():
            report[name][panel] = {}
            for factor, case in of_factor.items():
                figures = measure(case, repeats)
                report[name][panel][factor] = figures
                print(f"{name:16} {panel:8} x{factor:<3} {1000 * figures['median']:8.1f} ms", flush=True)
    return report


def per_cluster(figures: Dict[str, Any]) -> float:
    """Milliseconds of the stages that work on pixels and clusters."""
    return 1000 * sum(s for stage, s in figures["stages"].items() if stage not in PER_POINT)


def draw(report: Dict[str, Any], title: str, file: Path) -> None:
    """Three panels, a line per setting; dashed: proportional to the first point."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    labels = {
        "points": "points in the same pixels, times as many",
        "area": "occupied area, times as large",
        "windows": "windows in a batch",
    }
    figure, axes = pyplot.subplots(2, 3, figsize=(12, 6.4), layout="constrained")
    for row, (name, panels) in zip(axes, report.items()):
        for axis, (panel, of_factor) in zip(row, panels.items()):
            factors = sorted(of_factor)
            total = [1000 * of_factor[k]["median"] for k in factors]
            axis.plot(factors, total, "o-", color="#1f4e79", label="whole method")
            if panel == "points":
                inner = [per_cluster(of_factor[k]) for k in factors]
                axis.plot(factors, inner, "s-", color="#c55a11", label="cluster, correlate, pool")
            else:
                line = [total[0] * k for k in factors]
                axis.plot(factors, line, "--", color="#7f7f7f", label="proportional")
            axis.set(xlabel=labels[panel], ylabel="ms", title=name, xlim=(0, None), ylim=(0, None))
            axis.grid(alpha=0.3)
            axis.legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=10)
    figure.savefig(file, dpi=110)
    pyplot.close(figure)


def main() -> None:
    """Measure, write the JSON, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Path(__file__).resolve().parents[2] / "docs" / "benchmarks"
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=default)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    report = measure_all(options.repeats)
    options.folder.mkdir(parents=True, exist_ok=True)
    about = {"machine": machine(), "threads": options.threads, "torch": torch.__version__, "repeats": options.repeats}
    text = json.dumps({**about, "results": report}, indent=1)
    (options.folder / "growth.json").write_text(text + "\n")
    threads = f"{options.threads} thread{'s' if options.threads > 1 else ''}"
    title = f"medians of {options.repeats} runs, {threads}, {machine()['cpu']}, torch {torch.__version__}"
    draw(report, title, options.folder / "growth.png")
    print(f"written to {options.folder}")


if __name__ == "__main__":
    main()
