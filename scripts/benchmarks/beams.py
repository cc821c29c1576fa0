"""Score which points move with all beams of a LiDAR, and with every second and every fourth beam.

  python scripts/benchmarks/beams.py DATA/kitti-0000/*.h5 DATA/pandaset-002/*.h5

Moving IoU of `default` with four older sweeps: points without ground, within 50 m, with a valid label; a point moves if
its true residual flow is at least 0.05 m per sweep, and is predicted to move by `FlowResult.is_moving`. Windows with
fewer than four older sweeps are left out.

KITTI stores beam after beam, so its beams are exact. PandaSet's files have lost them: we take the beam of Pandar64
whose elevation is nearest, seen from 1.45 m above the origin, which mixes neighbouring beams.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from labelled import LabelledLog, true_residual
from table import markdown

from cflow_torch import Sweep, make_config, make_model
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.log import CachedLog, FlowLabels, LogWrapper, window

HISTORY, NEAR = 4, 50.0
STEPS = {64: 1, 32: 2, 16: 4}  # beams -> one of how many is kept
PANDAR64 = np.concatenate([[15, 11, 8, 5, 3], 2 - np.arange(49) / 6, -np.arange(7.0, 15), [-19, -25]])  # degrees
SENSOR_HEIGHT = 1.45  # metres above the origin of PandaSet's points


class ThinnedLog(LogWrapper):
    """A log with one of `step` beams."""

    def __init__(self, log: LabelledLog, step: int) -> None:
        super().__init__(log)
        self._is_kept = lru_cache(8)(lambda index: beams_of(log.log_id, log.sweep(index).points) % step == 0)

    def sweep(self, index: int) -> Sweep:
        sweep = self.log.sweep(index)
        is_kept = self._is_kept(index)
        return replace(sweep, points=sweep.points[is_kept], is_ground=sweep.is_ground[is_kept])

    def labels(self, index: int) -> FlowLabels | None:
        labels, is_kept = self.log.labels(index), self._is_kept(index)
        if labels is None:
            return None
        return FlowLabels(labels.flow[is_kept], labels.category[is_kept], labels.is_valid[is_kept])


def beams_of(log_id: str, points: np.ndarray) -> np.ndarray:
    """Return the index of the beam of each point, (N,) int64."""
    if log_id.startswith("kitti"):  # the azimuth runs once around for each beam
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        return np.concatenate([[0], np.cumsum(np.abs(np.diff(azimuth)) > np.pi)])
    elevation = np.degrees(np.arctan2(points[:, 2] - SENSOR_HEIGHT, np.hypot(points[:, 0], points[:, 1])))
    middle = (PANDAR64[:-1] + PANDAR64[1:]) / 2
    return len(PANDAR64) - 1 - np.searchsorted(middle[::-1], elevation)


def moving_iou(model: torch.nn.Module, log: Any) -> dict[str, float]:
    """Return the IoU of moving points, and their number per window."""
    counts = np.zeros(3)  # both, predicted, true
    windows = range(HISTORY, len(log.timestamps) - 1)
    for index in windows:
        sweeps, labels = window(log, index, HISTORY), log.labels(index)
        points = np.asarray(sweeps.pc0.points)
        is_scored = labels.is_valid & ~np.asarray(sweeps.pc0.is_ground)
        is_scored &= np.hypot(points[:, 0], points[:, 1]) < NEAR
        moves = np.linalg.norm(true_residual(log, index), axis=1)[is_scored] >= MOVING
        predicted = model([sweeps])[0].is_moving.numpy()[is_scored]
        counts += (moves & predicted).sum(), predicted.sum(), moves.sum()
    both, predicted, true = counts.tolist()
    return {"iou": both / max(predicted + true - both, 1), "moving points": true / len(windows)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", type=Path)
    torch.set_num_threads(1)
    model = make_model(make_config("default"), "cpu")
    ious: list[dict[str, Any]] = []
    points: list[dict[str, Any]] = []
    for path in parser.parse_args().paths:
        log = LabelledLog(path)
        ious.append({"moving IoU": log.log_id})
        points.append({"moving points per sweep": log.log_id})
        for beams, step in STEPS.items():
            scores = moving_iou(model, CachedLog(ThinnedLog(log, step), HISTORY + 3))
            ious[-1][f"{beams} beams"] = f"{scores['iou']:.3f}"
            points[-1][f"{beams} beams"] = f"{scores['moving points']:.0f}"
        print(ious[-1], flush=True)
    print(markdown(ious))
    print(markdown(points))


if __name__ == "__main__":
    main()
