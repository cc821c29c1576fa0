#!/usr/bin/env python3
"""Accuracy over history h x number of scales (the paper's figures benefit_historical and benefit_multiscale).

  python scripts/history_by_scales.py                               fixed synthetic set: 4 drives, 40 windows
  python scripts/history_by_scales.py --hdf5 FOLDER                 scenes in OpenSceneFlow's layout

Prints Markdown: dynamic bucket-normalised error per class, EPE of moving points and of the background. All settings see
the same windows; the first 8 sweeps of a simulated drive only serve as history (with --hdf5 every pair is scored).
"""

from __future__ import annotations

import argparse
from typing import Dict, Iterator, List, Optional, Tuple

import numpy as np
from tqdm import tqdm

from cflow_torch import CorrelationFlow, Window, make_config
from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes
from cflow_torch.data.log import FlowLabels, Log, window
from cflow_torch.data.synthetic import make_drive
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.evaluation.metrics import SceneFlowMetrics

HISTORIES = (0, 2, 4, 8)
SCALES = {1: (0.1,), 2: (0.2, 0.1), 3: (0.4, 0.2, 0.1), 5: (0.8, 0.4, 0.3, 0.2, 0.1)}
CLASSES = ("CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU")
SEEDS = (100, 101, 102, 103)
WINDOWS_PER_DRIVE = 10

Item = Tuple[Window, FlowLabels, Optional[np.ndarray]]


def windows(log: Log, first: int) -> Iterator[Item]:
    """Labelled windows with the longest history there is, from sweep `first` on."""
    for index in range(first, len(log.timestamps) - 1):
        labels = log.labels(index)
        if labels is not None:
            mask = log.eval_mask(index) if isinstance(log, HDF5Log) else None
            yield window(log, index, HISTORIES[-1]), labels, mask


def load(hdf5: Optional[str]) -> List[Item]:
    """All windows of the set."""
    if hdf5:
        return [item for file in find_hdf5_scenes(hdf5) for item in windows(HDF5Log(file), 0)]
    first = HISTORIES[-1]
    drives = [make_drive(seed=seed, num_sweeps=first + WINDOWS_PER_DRIVE + 1) for seed in SEEDS]
    return [item for drive in drives for item in windows(drive, first)]


def score(items: List[Item], num_history: int, pixel_sizes: Tuple[float, ...]) -> Dict[str, float]:
    """Figures of one setting over all windows."""
    model = CorrelationFlow(make_config("paper", num_history=num_history, pixel_sizes=pixel_sizes))
    metrics = SceneFlowMetrics("opensceneflow")
    for longest, labels, mask in items:
        shorter = Window(longest.pc0, longest.pc1, longest.pch[:num_history])
        (result,) = model([shorter])
        metrics.update(EvalFrame.from_result(shorter, result, labels, eval_mask=mask))
    results = metrics.compute()
    row = {name: results["bucketed"]["classes"][name]["dynamic_error"] for name in CLASSES}
    row["mean"] = results["bucketed"]["mean"]["dynamic_error"]
    row["EPE FD"], row["EPE BS"] = results["three_way"]["epe_fd"], results["three_way"]["epe_bs"]
    return row


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hdf5", help="a scene file or a folder of scenes; default: the synthetic set")
    items = load(parser.parse_args().hdf5)
    settings = [(h, n) for h in HISTORIES for n in SCALES]
    rows = {setting: score(items, setting[0], SCALES[setting[1]]) for setting in tqdm(settings, unit="setting")}
    columns = list(rows[settings[0]])
    print(
        f"{len(items)} windows; history h, number of scales; classes: dynamic bucket-normalised error; EPE in metres\n"
    )
    print("| h | scales | " + " | ".join(columns) + " |")
    print("|---|---|" + "---|" * len(columns))
    for (h, scales), row in rows.items():
        cells = ["-" if np.isnan(row[name]) else f"{row[name]:.4f}" for name in columns]
        print(f"| {h} | {scales} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
