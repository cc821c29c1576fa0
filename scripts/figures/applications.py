#!/usr/bin/env python3
"""Draw the pictures of docs/applications.md from simulated drives.

python scripts/figures/applications.py                    all of them: docs/pictures/tracks.png, clean.png, ...
python scripts/figures/applications.py --only stream      one of them; for the stream, also print its latencies
"""

from __future__ import annotations

import argparse
import tempfile
import time
from functools import lru_cache
from pathlib import Path
from typing import Any, Callable

import drives
import matplotlib
import numpy as np
import torch
from matplotlib.patches import Rectangle

from cflow_torch import CleanLog, FlowResult, FlowStream, make_config, make_model, static_map, track
from cflow_torch.applications.labels import label_scene
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.hdf5 import HDF5Log, write_hdf5_scene
from cflow_torch.data.log import Log, window, windows
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import make_drive
from cflow_torch.transforms import transform_points
from cflow_torch.viz.clusters import PALETTE
from cflow_torch.viz.style import FAINT, GROUND, INK, STATIC, add_panel, blank_figure
from cflow_torch.windows.deskewing import deskew_objects

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "pictures"
CROSSING_SWEEPS = 16
VIEW = 32.0  # metres from the middle of the crossing to each side
BACKGROUND = "#9aa0a6"
LABELLED, REACH = 4, (-30, 40, -18, 18)  # the sweep; metres shown: x, y
COLOURS = np.array(["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#117733"])
STREAMED, INTERVAL = 40, 0.1  # sweeps; seconds between them


@lru_cache(maxsize=None)
def crossing() -> tuple[Log, list[FlowResult]]:
    log, model = make_drive(301, CROSSING_SWEEPS, "av2", "crossing"), make_model(make_config("offline"))
    return log, [model([each])[0] for each in windows(log, model.config.num_history, model.config.num_future)]


def tracks(file: Path) -> None:
    """Boxes and ids at the last sweep, and the path of each track until then, over the points of the sweep."""
    log, flow = crossing()
    last = len(flow) - 1
    sweep = log.sweep(last)
    points = transform_points(sweep.points[~sweep.is_ground], sweep.pose)
    table = track(log, enumerate(flow))
    figure, (axes,) = square_panels(1)
    axes.scatter(points[:, 0], points[:, 1], s=0.15, c=BACKGROUND, linewidths=0)
    for row in np.flatnonzero(table["sweep"] == last):
        number = table["id"][row]
        colour = PALETTE[number % len(PALETTE)] / 255
        before = table["id"] == number
        axes.plot(table["x"][before], table["y"][before], color=colour, lw=1.2)
        x, y, angle = (table[name][row] for name in ("x", "y", "heading"))
        length, width = table["length"][row], table["width"][row]
        box = {"angle": np.degrees(angle), "rotation_point": "center", "fill": False, "color": colour, "lw": 1.2}
        axes.add_patch(Rectangle((x - length / 2, y - width / 2), length, width, **box))
        if max(abs(x), abs(y)) < VIEW - 3:
            speed = np.hypot(table["vx"][row], table["vy"][row])
            axes.annotate(f"{number}: {speed:.1f}", (x + 0.6, y + 0.9), fontsize=6, color=0.7 * colour)
    axes.set_title(f"tracks after {last + 1} sweeps: id, speed in m/s; lines: the path so far", fontsize=9)
    figure.savefig(file, bbox_inches="tight")


def clean(file: Path) -> None:
    """The map of the crossing from above, with and without dynamic objects; higher points are darker."""
    log, flow = crossing()
    figure, both = square_panels(2)
    cleaned = CleanLog(log, flow=flow.__getitem__, remove_stopped=True)
    for axes, each, title in zip(both, (log, cleaned), ("all points of the drive", "without dynamic objects")):
        x, y, z = static_map(each, 0.15).T
        order = z.argsort()
        axes.scatter(x[order], y[order], s=0.12, c=z[order], cmap="viridis_r", vmin=-0.5, vmax=4, linewidths=0)
        axes.set_title(title, fontsize=9)
    figure.savefig(file, bbox_inches="tight")


def square_panels(count: int) -> Any:
    """A figure of square views of the crossing."""
    figure, axes = plt.subplots(1, count, figsize=(6.4 * count, 6.6), dpi=125, squeeze=False)
    for each in axes[0]:
        each.set(xlim=(-VIEW, VIEW), ylim=(-VIEW, VIEW), aspect="equal", xlabel="x, metres in the world")
    return figure, axes[0]


def labels(file: Path) -> None:
    """The labels of `cflow label` for a sweep, next to the truth."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "drive.h5"
        write_hdf5_scene(make_drive(seed=300, num_sweeps=9, profile="av2", scene="crossing"), scene)
        label_scene(scene, make_model(make_config("offline"), "cpu"))
        with HDF5Log(scene) as log:
            keys = ("lidar", "ground_mask", "dufo", "dufocluster", "cluster", "nnd", "flow", "flow_instance_id")
            values = {key: log.values(LABELLED, key) for key in keys}
            T = np.linalg.inv(log.poses[LABELLED + 1]) @ log.poses[LABELLED]
    points, ground = values["lidar"], values["ground_mask"]
    residual = values["flow"] - ego_motion_flow(points, T)
    moves = np.linalg.norm(residual, axis=1) >= MOVING
    shown = [
        ("truth: moving points, by object", moves * values["flow_instance_id"] + 0),
        ("dufo and dufocluster: moving points, by group", values["dufocluster"]),
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
    figure.savefig(file)


def stream(file: Path) -> None:
    """Processor time from each sweep of a drive to the flow of the one before it; also print the medians."""
    sweeps = list(make_drive(seed=0, num_sweeps=STREAMED, profile="av2"))
    figure, axes = plt.subplots(figsize=(7.0, 2.6), layout="constrained")
    for preset, num_history in (("default", 4), ("default", 2), ("default", 0), ("paper", 0)):
        flows, ms = FlowStream(preset, num_history=num_history, device="cpu"), []
        for sweep in sweeps:
            begin = time.process_time()
            flows.push(sweep)
            ms.append(1000 * (time.process_time() - begin))
        del ms[0]  # there is no flow yet
        name = f"{preset}, h = {num_history}"
        print(f"{name}: median {np.median(ms):.0f} ms, 99 % within {np.percentile(ms, 99):.0f} ms")
        axes.plot(range(1, STREAMED), ms, ".-", label=name)
    axes.axhline(1000 * INTERVAL, color="0.6", linewidth=0.8)
    axes.text(0, 1000 * INTERVAL, "the next sweep", ha="left", va="top", color="0.4", fontsize=8)
    axes.set(xlabel="sweep", ylabel="latency on one core (ms)", ylim=(0, None))
    figure.legend(frameon=False, ncols=4, loc="outside upper center", fontsize=8)
    figure.savefig(file, dpi=110)


def deskewed(file: Path) -> None:
    """Cars measured by two spinning LiDARs, before and after de-skewing."""
    model = make_model(make_config("default"), "cpu")
    sweeps = window(drives.rolling_shutter(0).drive, drives.PAIR, model.config.num_history)
    (result,) = model([sweeps])
    given, times = np.asarray(sweeps.pc0.points), np.asarray(sweeps.pc0.point_times)
    shown = result.is_valid.numpy() & (np.abs(given[:, 1]) < 7)
    figure, axes = plt.subplots(2, 1, figsize=(8, 4.6), sharex=True, layout="constrained")
    for panel, points, title in zip(
        axes, (given, deskew_objects(sweeps, result).numpy()), ("as measured", "de-skewed")
    ):
        dots = panel.scatter(*points[shown, :2].T, s=1.5, c=1000 * times[shown], cmap="viridis", linewidths=0)
        panel.set(title=title, aspect="equal", xlim=(-30, 26), ylim=(-7, 7))
    figure.colorbar(dots, ax=axes, label="measured, ms after the time stamp of the sweep", shrink=0.8)
    figure.savefig(file, dpi=110)


PICTURES: dict[str, Callable[[Path], None]] = {
    each.__name__: each for each in (tracks, clean, labels, stream, deskewed)
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=tuple(PICTURES), default=tuple(PICTURES))
    given = parser.parse_args()
    torch.set_num_threads(1)
    for name in given.only:
        PICTURES[name](FOLDER / f"{name}.png")


if __name__ == "__main__":
    main()
