#!/usr/bin/env python3
"""Measure `default` on KITTI raw drives whose sweeps were never de-skewed, as read by `deskew=auto` and by `off`.

  python scripts/benchmarks/raw_drives.py DATA/kitti-raw-0027-empty16.h5 DATA/kitti-raw-0027-b2.h5

moving: share of the points within 35 m, without ground, that move by at least 0.05 m per sweep. error: end-point error
of the labelled points that truly move so, divided by their speed, over all windows; "-" without labels. With `auto`,
the truth is converted to the instants of the sweeps, with `off`, it is that of the points as measured.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np
import torch
from labelled import true_residual

from cflow_torch import make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.config import make_config
from cflow_torch.data.catalog import open_log
from cflow_torch.data.log import CachedLog, Log, window

HISTORY, NEAR = 4, 35.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    model = make_model(make_config("default"), "cpu")
    print("| drive | deskew | moving | error |\n|---|---|---|---|")
    for path in parser.parse_args().paths:
        for deskew in ("auto", "off"):
            moving, error = measure(model, open_log("hdf5", path, check=False, deskew=deskew))
            print(f"| {path.stem} | {deskew} | {moving:.2%} | {'-' if error is None else f'{error:.3f}'} |", flush=True)


def measure(model: torch.nn.Module, log: Log) -> tuple[float, float | None]:
    """Return the share of moving points, and the error divided by the speed, None without labels."""
    cached = CachedLog(log, HISTORY + 3)
    sums = np.zeros(4)  # moving points, points, error, speed
    for index in range(HISTORY, len(log) - 1):
        sweeps = window(cached, index, HISTORY)
        flow = model([sweeps])[0].residual_flow.numpy()
        points = np.asarray(sweeps.pc0.points, dtype=np.float64)
        distance = np.hypot(points[:, 0], points[:, 1])
        is_near = (distance < NEAR) & ~np.asarray(sweeps.pc0.is_ground) & np.isfinite(points).all(1)
        sums[:2] += (np.linalg.norm(flow, axis=1)[is_near] >= MOVING).sum(), is_near.sum()
        labels = log.labels(index)
        if labels is None:
            continue
        truth = true_residual(log, index)
        speed = np.linalg.norm(truth, axis=1)
        is_scored = is_near & labels.is_valid & (speed >= MOVING)
        sums[2:] += np.linalg.norm(flow - truth, axis=1)[is_scored].sum(), speed[is_scored].sum()
    return sums[0] / sums[1], sums[2] / sums[3] if sums[3] > 0 else None


if __name__ == "__main__":
    main()
