#!/usr/bin/env python3
"""Pictures of docs/applications.md: tracks of a simulated crossing, and its map with and without what moves.

python scripts/figures/tracks_and_maps.py                 writes docs/pictures/tracks.png and clean.png
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Dict

import matplotlib
import numpy as np
import torch

from cflow_torch import CleanLog, make_config, make_model, static_map, track
from cflow_torch.data.log import windows
from cflow_torch.simulator import make_drive
from cflow_torch.viz.clusters import PALETTE

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

VIEW = 32.0  # metres each way from the middle of the crossing
STANDING = "#9aa0a6"


def draw_tracks(axes: Any, points: np.ndarray, table: Dict[str, np.ndarray], index: int) -> None:
    """Boxes and ids at a sweep, and the way of each track until then, over the points of the sweep."""
    axes.scatter(points[:, 0], points[:, 1], s=0.15, c=STANDING, linewidths=0)
    for row in np.flatnonzero(table["sweep"] == index):
        number = table["id"][row]
        colour = PALETTE[number % len(PALETTE)] / 255
        before = (table["id"] == number) & (table["sweep"] <= index)
        axes.plot(table["x"][before], table["y"][before], color=colour, lw=1.2)
        x, y, angle = (table[name][row] for name in ("x", "y", "heading"))
        along = table["length"][row] / 2 * np.array([np.cos(angle), np.sin(angle)])
        across = table["width"][row] / 2 * np.array([-np.sin(angle), np.cos(angle)])
        corners = np.stack([a * along + b * across for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1), (1, 1))])
        axes.plot(x + corners[:, 0], y + corners[:, 1], color=colour, lw=1.2)
        if max(abs(x), abs(y)) < VIEW - 3:
            speed = np.hypot(table["vx"][row], table["vy"][row])
            axes.annotate(f"{number}: {speed:.1f}", (x + 0.6, y + 0.9), fontsize=6, color=0.7 * colour)


def draw_map(axes: Any, points: np.ndarray) -> None:
    """A map from above, darker where it is higher."""
    order = points[:, 2].argsort()
    axes.scatter(*points[order, :2].T, s=0.12, c=points[order, 2], cmap="viridis_r", vmin=-0.5, vmax=4, linewidths=0)


def new_panels(count: int) -> Any:
    """A figure of square views."""
    figure, axes = plt.subplots(1, count, figsize=(6.4 * count, 6.6), dpi=125, squeeze=False)
    for each in axes[0]:
        each.set(xlim=(-VIEW, VIEW), ylim=(-VIEW, VIEW), aspect="equal", xlabel="x, metres in the world")
    return figure, axes[0]


def main() -> None:
    """Simulate, estimate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path(__file__).resolve().parents[2] / "docs" / "pictures")
    parser.add_argument("--model", default="offline")
    parser.add_argument("--num-sweeps", type=int, default=16)
    given = parser.parse_args()
    torch.set_num_threads(1)
    log = make_drive(301, given.num_sweeps, "av2", "crossing")
    model = make_model(make_config(given.model))
    settings = model.config
    flow = [model([each])[0] for each in windows(log, settings.num_history, settings.num_future)]

    last = len(flow) - 1
    table = track(log, enumerate(flow))
    sweep = log.sweep(last)
    points = sweep.points[~sweep.is_ground].astype(float) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
    figure, (axes,) = new_panels(1)
    draw_tracks(axes, points, table, last)
    axes.set_title(f"tracks after {last + 1} sweeps: id, speed in m/s; lines: the way so far", fontsize=9)
    figure.savefig(given.folder / "tracks.png", bbox_inches="tight")

    clean = CleanLog(log, flow=flow.__getitem__, standing=True)
    figure, both = new_panels(2)
    for axes, each, title in zip(both, (log, clean), ("all points of the drive", "without what moves")):
        draw_map(axes, static_map(each, 0.15))
        axes.set_title(title, fontsize=9)
    figure.savefig(given.folder / "clean.png", bbox_inches="tight")


if __name__ == "__main__":
    main()
