#!/usr/bin/env python3
"""The method beside a plain OpenCV loop, HDBSCAN and itself, on the same window in the same process.

  python scripts/benchmarks/against_opencv.py                                       a simulated street
  python scripts/benchmarks/against_opencv.py --data-set av2 --root /data/av2/val/LOG --repeats 50

Prints three tables and writes them to OUTPUT as JSON: the paper's method against the loop of `opencv_loop.py`, with how
far both agree and what the method does and holds; single stages and other methods; the presets against `paper` at equal
history, region and scales. A ratio is the competitor's time over ours, the median of neighbouring runs: above 1 we are
faster. Needs opencv-python-headless.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Callable, Dict, List, Sequence

import numpy as np
import torch
from counts import count_allocations, count_work
from opencv_loop import dilate_and_label, find_clusters, opencv_flow
from table import markdown
from timing import alternate, median_ratio, synchronise, threads

from cflow_torch import CFlowError, Config, FlowResult, Window, make_config, make_model
from cflow_torch.cli.run import machine
from cflow_torch.data.catalog import find_sources, open_log
from cflow_torch.data.log import window
from cflow_torch.dense import clustering
from cflow_torch.dense.hdbscan import hdbscan_labels
from cflow_torch.dense.projection import project
from cflow_torch.simulator import make_drive
from cflow_torch.windows.collation import make_batch

PAIR = make_config("paper")
WIDE = PAIR.replace(point_cloud_range=[2 * bound for bound in PAIR.point_cloud_range])
FULL = PAIR.replace(num_history=4, pixel_sizes=(0.8, 0.4, 0.3, 0.2, 0.1))  # the paper's figure benefit_multiscale
DENSE = {"h = 0, 1 scale, ±35 m": PAIR, "h = 0, 1 scale, ±70 m": WIDE, "h = 4, 5 scales, ±35 m": FULL}
SAME_FLOW = 1e-5  # metres; shifts are whole pixels, so different ones are centimetres apart
HISTORY = FULL.num_history
Rows = List[List[Any]]


def load(data_set: str, root: str) -> Window:
    """A window with four older sweeps, of a simulated street or of the first log below a folder."""
    log: Any = make_drive(seed=7, num_sweeps=HISTORY + 2, profile="av2")
    if root:
        log = open_log(data_set, find_sources(data_set, root)[0])
    return window(log, min(HISTORY, len(log.timestamps) - 2), HISTORY)


def with_history_of(config: Config, sweeps: Window) -> Window:
    """The window without the older sweeps that a config does not take."""
    return replace(sweeps, pch=sweeps.pch[: config.num_history])


def agreement(result: FlowResult, other: FlowResult, distance: float) -> float:
    """Share of the valid points whose residual flows differ by at most this much along each axis."""
    apart = (result.residual_flow.cpu() - other.residual_flow).abs().amax(1)[result.is_valid.cpu()]
    return float((apart <= distance + SAME_FLOW).double().mean())


def against_loop(sweeps: Window, repeats: int, device: str) -> Rows:
    """The paper's method against the OpenCV loop, a row per configuration."""
    rows: Rows = [
        ["", "ms", "OpenCV loop ms", "ratio", "same flow", "within a pixel", "operations", "waits", "peak MB"]
    ]
    for name, config in DENSE.items():
        if config.num_history > len(sweeps.pch):
            continue
        model, of_config = make_model(config, device), with_history_of(config, sweeps)
        ours, theirs = alternate([ready(model, of_config), lambda: opencv_flow(of_config, config)], repeats)  # noqa: B023
        result, other = model([of_config])[0], opencv_flow(of_config, config)
        work = count_work(lambda: model([of_config]))  # noqa: B023
        _, peak = count_allocations(lambda: model([of_config]))  # noqa: B023
        shares = [agreement(result, other, distance) for distance in (0.0, config.pixel_sizes[0])]
        times = [milliseconds(ours), milliseconds(theirs), median_ratio(ours, theirs)]
        rows.append([name, *times, *shares, work["operations"], work["waits"], peak / 1e6])
    return rows


def stages_and_methods(sweeps: Window, repeats: int, device: str) -> Rows:
    """The clustering stage against OpenCV and HDBSCAN, key points against the dense method."""
    pair = with_history_of(PAIR, sweeps)
    model = make_model(PAIR, device)
    grid = model.grid(PAIR.pixel_sizes[-1])
    batch = make_batch([pair], PAIR, grid, torch.device(device), num_axes=3)  # HDBSCAN takes z
    projected = project(batch, None, grid)
    images = [image.byte().cpu().numpy() for image in projected.occupancy[0]]
    aggregated = np.bitwise_or.reduce(images)

    def cluster() -> None:
        synchronise(clustering.find_clusters(projected, PAIR)[1])

    ours, loop, bare = alternate(
        [
            cluster,
            lambda: find_clusters(images, PAIR.pixel_sizes[-1], PAIR),
            lambda: dilate_and_label(aggregated, PAIR.connectivity),
        ],
        repeats,
    )
    rows: Rows = [["", "ms", "competitor", "its ms", "ratio"]]
    for name, theirs in (("the OpenCV loop's", loop), ("two bare calls: dilate, connectedComponents", bare)):
        rows.append(["clustering", milliseconds(ours), name, milliseconds(theirs), median_ratio(ours, theirs)])
    points = batch.positions[:, batch.takes_part].t().cpu().numpy()
    try:
        hdbscan_labels(points[:100], 20)  # imported and compiled
        start = time.perf_counter()
        hdbscan_labels(points, 20)
        theirs = [time.perf_counter() - start]
        rows.append(["clustering", milliseconds(ours), "HDBSCAN, once", milliseconds(theirs), theirs[0] / min(ours)])
    except CFlowError as error:
        print(error)
    region = {"point_cloud_range": WIDE.point_cloud_range}
    keys = {name: make_config(name, method="keypoints", **region) for name in ("paper", "keypoints")}
    models = [make_model(config, device) for config in (WIDE, *keys.values())]
    dense, *others = alternate([ready(model, pair) for model in models], repeats)
    for name, ours in zip(keys, others):
        cells = [milliseconds(ours), "dense, h = 0, ±70 m", milliseconds(dense), median_ratio(ours, dense)]
        rows.append([f"key points, preset {name}, ±70 m", *cells])
    return rows


def presets(sweeps: Window, repeats: int, device: str) -> Rows:
    """`default` and `fast` against `paper` at equal history, region and scales."""
    rows: Rows = [["", "h", "ms", "paper ms", "times as long"]]
    for name in ("default", "fast"):
        for history in sorted({0, min(HISTORY, len(sweeps.pch))}):
            config = make_config(name, num_history=history, point_cloud_range=PAIR.point_cloud_range)
            paper = PAIR.replace(num_history=history, pixel_sizes=config.pixel_sizes)
            of_config = with_history_of(config, sweeps)
            runs = [ready(make_model(each, device), of_config) for each in (config, paper)]
            ours, theirs = alternate(runs, repeats)
            rows.append([name, history, milliseconds(ours), milliseconds(theirs), median_ratio(theirs, ours)])
    return rows


def ready(model: Any, sweeps: Window) -> Callable[[], None]:
    """A call that ends when the flow is there."""
    return lambda: synchronise(model([sweeps])[0].flow)


def milliseconds(seconds: Sequence[float]) -> float:
    """Of a median."""
    return 1000 * statistics.median(seconds)


PARTS = {"against the OpenCV loop": against_loop, "stages and methods": stages_and_methods, "presets": presets}


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data-set", default="av2", help="data set of --root, as in cflow's data=")
    parser.add_argument("--root", default="", help="a log or a folder of logs; default: a simulated street")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=Path("outputs/benchmarks/against_opencv.json"))
    given = parser.parse_args()
    sweeps = load(given.data_set, given.root)
    report: Dict[str, Any] = {"machine": machine(), "torch": torch.__version__, "threads": given.threads}
    report.update(points=len(sweeps.pc0.points), older_sweeps=len(sweeps.pch), repeats=given.repeats)
    print(json.dumps(report))
    with threads(given.threads):
        for name, part in PARTS.items():
            rows = part(sweeps, given.repeats, given.device)
            report[name] = [dict(zip(rows[0], row)) for row in rows[1:]]
            print(f"\n{name}\n\n{markdown(rows)}", flush=True)
    given.output.parent.mkdir(parents=True, exist_ok=True)
    given.output.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
