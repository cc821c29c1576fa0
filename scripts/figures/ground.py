#!/usr/bin/env python3
"""Accuracy and time of ground finding: simulated drives, the Argoverse 2 pair against its map, KITTI's stored mask.

  python scripts/figures/ground.py                          every table; a method or data set that is absent is left out
  CFLOW_DATA=FOLDER python scripts/figures/ground.py        where the real data lies (else ../shared/data)

Prints Markdown, and a line per call from Patchwork++ (`| grep '^|'` drops it). "raster rule": ground is what lies at
most 0.3 m above the true surface, or below it. "hit": the ray met the ground. Times are the median of 15 calls for one
sweep on one thread.
"""

from __future__ import annotations

import os
import statistics
import time
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, Tuple

import numpy as np
import pyarrow.feather as feather
import torch

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.ground import read_ground_raster
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.types import CFlowError
from cflow_torch.windows.ground import find_ground, has_ground

SEEDS = (410, 411, 412)  # the settings were tuned on 400 ... 409
AV2 = Path("av2-7fab2350", "val", "7fab2350-7eaf-3b7e-a39d-6937a4c1bede")
SHIFTS = (-2.0, -1.0, 0.35)  # of z, so that the ground lies 2.35 m ... 0 m below the origin

METHODS: Dict[str, Dict[str, Any]] = {
    "grid": {},
    "grid, threshold 0.15 m": {"threshold": 0.15},
    "patchwork": {"method": "patchwork"},
}
Case = Tuple[str, np.ndarray, np.ndarray, np.ndarray]  # name, points, true mask, points that count


def simulated() -> Iterator[Case]:
    """Every sensor profile, both truths; for one also other mounting heights, multipath, hills."""
    for profile in PROFILES:
        for seed in SEEDS:
            drive = make_drive(seed=seed, num_sweeps=1, profile=profile)
            sweep = drive.sweep(0)
            points = sweep.points.astype(np.float64)
            world = points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
            above = world[:, 2] - drive.scene.ground.height(world[:, 0], world[:, 1])
            truth, every = above <= 0.3, np.ones(len(points), bool)
            yield f"simulated `{profile}`, raster rule", points, truth, every
            yield f"simulated `{profile}`, hit", points, np.asarray(sweep.is_ground), every
            if profile != "av2":  # the rest is told for one profile
                continue
            for shift in SHIFTS:
                yield f"simulated `av2`, raster rule, z {shift:+.2f} m", points + [0, 0, shift], truth, every
            rng = np.random.default_rng(seed)
            for share in (0.001, 0.01):
                rows = rng.choice(len(points), int(share * len(points)), replace=False)
                rain = points.copy()
                rain[rows, 2] -= above[rows] + rng.uniform(0.3, 4, len(rows))
                others = every.copy()
                others[rows] = False
                yield (
                    f"simulated `av2`, {share:.1%} of the points 0.3-4 m below ground, the others",
                    rain,
                    truth,
                    others,
                )
            wave = 1.5 * np.sin(2 * np.pi * (points[:, 0] + 0.5 * points[:, 1]) / 80) + 0.1 * points[:, 1]
            yield "simulated `av2` on hills (slope up to 0.23)", points + wave[:, None] * [0, 0, 1], truth, every


def real(root: Path) -> Iterator[Case]:
    """Sweeps of the real sets, if they are there."""
    if (root / AV2).is_dir():
        log, raster = AV2Log(root / AV2), read_ground_raster(root / AV2 / "map")
        for index in (0, 1):
            sweep = log.sweep(index)
            points, truth = np.asarray(sweep.points), np.asarray(sweep.is_ground)
            every = np.ones(len(points), bool)
            yield "Argoverse 2 pair, all points (off the raster nothing is ground)", points, truth, every
            if raster is None:
                continue
            city = points.astype(np.float64) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
            deep = np.concatenate([city[:, :2], np.full((len(city), 1), -1e6)], 1)
            on_raster = raster.is_ground(deep)  # what lies deep below is ground wherever the height is known
            yield "Argoverse 2 pair, on the raster", points, truth, on_raster
            box = np.abs(points[:, :2]).max(1) <= 51.2
            yield "Argoverse 2 pair, on the raster, box of 51.2 m", points, truth, on_raster & box
            if index == 0:
                label = feather.read_table(root / AV2 / "flow_labels.feather")["is_ground_0"].to_numpy()
                yield "Argoverse 2, sweep 0, is_ground_0 of flow_labels, on the raster", points, label, on_raster
    file = root / "kitti-0000" / "kitti-0000-a.h5"
    if file.is_file():
        with HDF5Log(file) as scene:
            for index in range(0, 16, 5):
                sweep = scene.sweep(index)
                points, truth = np.asarray(sweep.points), np.asarray(sweep.is_ground)
                yield "KITTI, stored mask (Patchwork++ + 0.2 m)", points, truth, np.ones(len(points), bool)


def scores(mask: np.ndarray, truth: np.ndarray, counts: np.ndarray) -> Tuple[float, float, float]:
    """Intersection over union, precision, recall."""
    mask, truth = mask & counts, truth & counts
    both = (mask & truth).sum()
    return both / (mask | truth).sum(), both / max(mask.sum(), 1), both / truth.sum()


def median_ms(call: Callable[[], object], calls: int = 15) -> Tuple[float, float]:
    """Median wall time and processor time in ms."""
    call()
    wall, busy = [], []
    for _ in range(calls):
        start = time.perf_counter(), time.process_time()
        call()
        wall.append(time.perf_counter() - start[0])
        busy.append(time.process_time() - start[1])
    return 1000 * statistics.median(wall), 1000 * statistics.median(busy)


def main() -> None:
    torch.set_num_threads(1)
    root = Path(os.environ.get("CFLOW_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    methods: Dict[str, Dict[str, Any]] = {}
    for method, settings in METHODS.items():
        try:
            find_ground(np.zeros((1, 3)), **settings)
            methods[method] = settings
        except CFlowError as error:
            print(f"left out: {error}\n")
    print("| sweeps | " + " | ".join(f"{m}: IoU | precision | recall" for m in methods) + " |")
    print("|---" * (1 + 3 * len(methods)) + "|")
    table: Dict[str, List[List[Tuple[float, float, float]]]] = {}
    for cases in (simulated(), real(root)):
        for name, points, truth, counts in cases:
            rows = table.setdefault(name, [[] for _ in methods])
            for row, settings in zip(rows, methods.values()):
                row.append(scores(find_ground(points, **settings), truth, counts))
    for name, rows in table.items():
        cells = []
        for row in rows:
            iou, precision, recall = np.mean(row, 0)
            cells += [f"{iou:.3f}", f"{precision:.3f}", f"{recall:.3f}"]
        print(f"| {name} ({len(rows[0])}) | " + " | ".join(cells) + " |")

    points = make_drive(seed=SEEDS[0], num_sweeps=1, profile="av2").sweep(0).points
    print(f"\n| one sweep of {len(points)} points, one thread | wall ms | processor ms |\n|---|---|---|")
    calls: Dict[str, Callable[[], object]] = {
        **{f"find_ground, {m}": (lambda s=s: find_ground(points, **s)) for m, s in methods.items()},
        "has_ground (the check behind the warning)": lambda: has_ground([points]),
    }
    for name, call in calls.items():
        wall, busy = median_ms(call)
        print(f"| {name} | {wall:.1f} | {busy:.1f} |")


if __name__ == "__main__":
    main()
