#!/usr/bin/env python3
"""Measure `default` on KITTI raw drives whose sweeps were never de-skewed, as read by `deskew=auto` and by `off`.

  python scripts/benchmarks/raw_drives.py DATA/kitti-raw-0027-empty16.h5 DATA/kitti-raw-0027-b2.h5

moving: share of the points within 35 m, without ground, that move by at least 0.05 m per sweep. The other columns have
the labelled points that truly move so, within 35 m and from 35 to 70 m, over all windows. error: their end-point error
divided by their speed. missed: share of those beyond 35 m that do not move in the result. sure: share of the missed
points whose confidence is above 0.5. "-" without labels. With `auto`, the truth is converted to the instants of the
sweeps, with `off`, it is that of the points as measured.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from labelled import true_residual

from cflow_torch import make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.config import make_config
from cflow_torch.data.catalog import open_log
from cflow_torch.data.log import CachedLog, Log, window

HISTORY, NEAR, FAR = 4, 35.0, 70.0


class Scores(NamedTuple):
    """The points of all windows of a drive: their distance, true speed, error, confidence, and what they are."""

    distance: np.ndarray  # (N,) metres
    speed: np.ndarray  # (N,) metres per sweep; NaN without a valid label
    error: np.ndarray  # (N,) metres
    confidence: np.ndarray  # (N,)
    is_moving: np.ndarray  # (N,) bool, in the result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path)
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    model = make_model(make_config("default"), "cpu")
    print("| drive | deskew | moving | error | error 35-70 m | missed | sure |\n|---|---|---|---|---|---|---|")
    for path in parser.parse_args().paths:
        for deskew in ("auto", "off"):
            scores = measure(model, open_log("hdf5", path, check=False, deskew=deskew))
            moving = scores.is_moving[scores.distance < NEAR].mean()
            print(f"| {path.stem} | {deskew} | {moving:.2%} | {' | '.join(columns(scores))} |", flush=True)


def measure(model: torch.nn.Module, log: Log) -> Scores:
    """Return the scores of all points of the log that are no ground."""
    cached = CachedLog(log, HISTORY + 3)
    parts = []
    for index in range(HISTORY, len(log) - 1):
        sweeps = window(cached, index, HISTORY)
        result = model([sweeps])[0]
        flow = result.residual_flow.numpy()
        points = np.asarray(sweeps.pc0.points, dtype=np.float64)
        labels = log.labels(index)
        truth = np.full_like(points, np.nan)
        if labels is not None:
            truth[labels.is_valid] = true_residual(log, index)[labels.is_valid]
        scores = Scores(
            distance=np.hypot(points[:, 0], points[:, 1]),
            speed=np.linalg.norm(truth, axis=1),
            error=np.linalg.norm(flow - truth, axis=1),
            confidence=result.confidence.numpy(),
            is_moving=np.linalg.norm(flow, axis=1) >= MOVING,
        )
        is_used = ~np.asarray(sweeps.pc0.is_ground) & np.isfinite(points).all(1)
        parts.append(Scores(*(values[is_used] for values in scores)))
    return Scores(*(np.concatenate(values) for values in zip(*parts)))


def columns(scores: Scores) -> list[str]:
    """Return the columns of the points that truly move."""
    is_dynamic = scores.speed >= MOVING
    is_near = is_dynamic & (scores.distance < NEAR)
    is_far = is_dynamic & (scores.distance >= NEAR) & (scores.distance < FAR)
    if not is_near.any() and not is_far.any():
        return ["-"] * 4
    is_missed = is_far & ~scores.is_moving
    return [
        f"{scores.error[is_near].sum() / scores.speed[is_near].sum():.3f}",
        f"{scores.error[is_far].sum() / scores.speed[is_far].sum():.3f}",
        f"{is_missed.sum() / is_far.sum():.1%}",
        f"{(scores.confidence[is_missed] > 0.5).mean():.0%} of {is_missed.sum()}",
    ]


if __name__ == "__main__":
    main()
