#!/usr/bin/env python3
"""docs/pictures/labels.png: what `cflow label` writes for a sweep of a simulated drive, beside the truth.

python scripts/figures/labels.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from cflow_torch import make_config, make_model
from cflow_torch.applications.labels import label_scene
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_scene
from cflow_torch.simulator import make_drive
from cflow_torch.viz.style import FAINT, GROUND, INK, STATIC, add_panel, blank_figure

FILE = Path(__file__).resolve().parents[2] / "docs" / "pictures" / "labels.png"
SWEEP, REACH = 4, (-30, 40, -18, 18)  # metres shown: x, y
COLOURS = np.array(["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#117733"])


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drive.h5"
        write_hdf5_scene(make_drive(seed=300, num_sweeps=9, profile="av2", scene="crossing"), file)
        label_scene(file, make_model(make_config("offline"), "cpu"))
        with HDF5Log(file) as log:
            keys = ("lidar", "ground_mask", "dufo", "dufocluster", "cluster", "nnd", "flow", "flow_instance_id")
            values = {key: log.values(SWEEP, key) for key in keys}
            T = np.linalg.inv(log.poses[SWEEP + 1]) @ log.poses[SWEEP]
    points, ground = values["lidar"], values["ground_mask"]
    residual = values["flow"] - (points @ T[:3, :3].T + T[:3, 3] - points)
    moves = np.linalg.norm(residual, axis=1) >= MOVING
    shown = [
        ("truth: points that move, by object", moves * values["flow_instance_id"] + 0),
        ("dufo and dufocluster: what moves, by group", values["dufocluster"]),
        ("cluster: all groups", values["cluster"]),
        ("nnd: the next sweep has nothing within 0.14 m", values["nnd"] * 2),
    ]
    x0, x1, y0, y1 = REACH
    figure = blank_figure((15, 8.6), 80)
    for number, (title, label) in enumerate(shown):
        row, column = divmod(number, 2)
        axes = add_panel(figure, 0.1 + 7.45 * column, 4.1 - 4.25 * row + 0.2, 7.3, 3.75)
        order = np.argsort(label > 0, kind="stable")
        colour = np.where(label > 0, COLOURS[label % len(COLOURS)], np.where(ground, GROUND, STATIC))
        axes.scatter(points[order, 0], points[order, 1], s=1.2, c=colour[order], linewidths=0)
        axes.set(xlim=(x0, x1), ylim=(y0, y1), xticks=[], yticks=[], aspect="equal")
        axes.set_title(title, fontsize=13, color=INK, pad=4)
        for spine in axes.spines.values():
            spine.set_color(FAINT)
    figure.savefig(FILE)
    print(f"{FILE}: {FILE.stat().st_size // 1024} kB")


if __name__ == "__main__":
    main()
