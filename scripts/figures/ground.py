#!/usr/bin/env python3
"""Accuracy and time of ground finding: simulated drives, the Argoverse 2 pair and its map, KITTI's stored mask.

  python scripts/figures/ground.py                          the table, without methods and data that are not available
  CFLOW_DATA=FOLDER python scripts/figures/ground.py        folder of the real data (default: ../shared/data)

Prints Markdown, and a line per call of Patchwork++ (`| grep '^|'` removes it). In simulated drives, points below or at
most 0.3 m above the true surface are ground. Processor times are medians of 15 calls for one sweep.
"""

from __future__ import annotations

import os
import statistics
import time
from pathlib import Path
from typing import Iterator, Tuple

import numpy as np
import torch

from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.ground import read_ground_raster
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.types import CFlowError
from cflow_torch.windows.ground import find_ground

SEEDS = (410, 411, 412)  # the settings were tuned on 400 ... 409
AV2 = Path("av2-7fab2350", "val", "7fab2350-7eaf-3b7e-a39d-6937a4c1bede")
METHODS = ("grid", "patchwork")
CALLS = 15
Case = Tuple[str, np.ndarray, np.ndarray, np.ndarray]  # name, points, true mask, mask of scored points


def simulated() -> Iterator[Case]:
    """A sweep of every sensor profile; for one of them also on hills."""
    for profile in PROFILES:
        for seed in SEEDS:
            drive = make_drive(seed=seed, num_sweeps=1, profile=profile)
            sweep = drive.sweep(0)
            points = sweep.points.astype(np.float64)
            world = points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
            above = world[:, 2] - drive.scene.ground.height(world[:, 0], world[:, 1])
            truth, every = above <= 0.3, np.ones(len(points), bool)
            yield f"simulated `{profile}`", points, truth, every
            if profile == "av2":
                wave = 1.5 * np.sin(2 * np.pi * (points[:, 0] + 0.5 * points[:, 1]) / 80) + 0.1 * points[:, 1]
                yield "simulated `av2` on hills (slope up to 0.23)", points + wave[:, None] * [0, 0, 1], truth, every


def real(root: Path) -> Iterator[Case]:
    """Sweeps of the available real data."""
    raster = read_ground_raster(root / AV2 / "map") if (root / AV2).is_dir() else None
    if raster is not None:
        log = AV2Log(root / AV2)
        for index in (0, 1):
            sweep = log.sweep(index)
            points, truth = np.asarray(sweep.points), np.asarray(sweep.is_ground)
            city = points.astype(np.float64) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
            deep = np.concatenate([city[:, :2], np.full((len(city), 1), -1e6)], 1)
            on_raster = raster.is_ground(deep)  # points far below the surface are ground wherever the height is known
            yield "Argoverse 2 pair, on the raster", points, truth, on_raster
    file = root / "kitti-0000" / "kitti-0000-a.h5"
    if file.is_file():
        with HDF5Log(file) as scene:
            for index in range(0, 16, 5):
                sweep = scene.sweep(index)
                points, truth = np.asarray(sweep.points), np.asarray(sweep.is_ground)
                yield "KITTI, stored mask (Patchwork++ + 0.2 m)", points, truth, np.ones(len(points), bool)


def scores(mask: np.ndarray, truth: np.ndarray, is_scored: np.ndarray) -> tuple[float, float, float]:
    """Intersection over union, precision, recall."""
    mask, truth = mask & is_scored, truth & is_scored
    both = (mask & truth).sum()
    return both / (mask | truth).sum(), both / max(mask.sum(), 1), both / truth.sum()


def median_ms(points: np.ndarray, method: str) -> float:
    """Median processor time of a call in ms."""
    seconds = []
    for _ in range(CALLS):
        start = time.process_time()
        find_ground(points, method=method)
        seconds.append(time.process_time() - start)
    return 1000 * statistics.median(seconds)


def main() -> None:
    """Print the tables."""
    torch.set_num_threads(1)
    root = Path(os.environ.get("CFLOW_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
    methods: list[str] = []
    for method in METHODS:
        try:
            find_ground(np.zeros((1, 3)), method=method)
            methods.append(method)
        except CFlowError as error:
            print(f"{method} is left out: {error}\n")
    print("| sweeps | " + " | ".join(f"{m}: IoU | precision | recall" for m in methods) + " |")
    print("|---" * (1 + 3 * len(methods)) + "|")
    table: dict[str, list[list[tuple[float, float, float]]]] = {}
    for cases in (simulated(), real(root)):
        for name, points, truth, is_scored in cases:
            rows = table.setdefault(name, [[] for _ in methods])
            for row, method in zip(rows, methods):
                row.append(scores(find_ground(points, method=method), truth, is_scored))
    for name, rows in table.items():
        cells = [f"{value:.3f}" for row in rows for value in np.mean(row, 0)]
        print(f"| {name} ({len(rows[0])}) | " + " | ".join(cells) + " |")

    points = make_drive(seed=SEEDS[0], num_sweeps=1, profile="av2").sweep(0).points
    print(f"\n| one sweep of {len(points)} points, one thread | processor ms |\n|---|---|")
    for method in methods:
        print(f"| {method} | {median_ms(points, method):.1f} |")


if __name__ == "__main__":
    main()
