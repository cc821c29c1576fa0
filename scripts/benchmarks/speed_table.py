#!/usr/bin/env python3
"""Compare the times of presets, settings and the OpenCV loop: medians of alternating runs in this process, one thread.

  python scripts/benchmarks/speed_table.py                                  a simulated street
  python scripts/benchmarks/speed_table.py /data/av2/val/LOG --repeats 50   the first log of a path

The table also has the launches and waits of a window, counted on a simulated accelerator (tests/pretend_device.py).
Needs opencv-python-headless, and torch 2.9 for the counts. `cflow bench` measures one setting in more detail.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, Callable, Dict, Iterator

import cv2
import torch
from opencv_loop import opencv_flow
from table import markdown

from cflow_torch import Config, Window, make_config, make_model
from cflow_torch.cli.outputs import machine
from cflow_torch.data.catalog import find_sources, open_log, recognise
from cflow_torch.data.log import Log, window
from cflow_torch.fleet.manifest import versions
from cflow_torch.simulator import make_drive

HISTORY = 4
PAPER, KEYS, DEFAULT = make_config("paper"), make_config("keypoints"), make_config("default")
# The settings of the paper's figure benefit_multiscale.
FULL = PAPER.replace(num_history=HISTORY, pixel_sizes=(0.8, 0.4, 0.3, 0.2, 0.1))
WIDE = PAPER.replace(point_cloud_range=DEFAULT.point_cloud_range)
WIDE_HISTORY = WIDE.replace(num_history=HISTORY)
WIDE_SCALES = WIDE_HISTORY.replace(pixel_sizes=DEFAULT.pixel_sizes)
Call = Callable[[Window], Any]
Rows = Iterator[Dict[str, Any]]


def of(config: Config) -> Call:
    """The flow by a model with these settings."""
    model = make_model(config, "cpu")
    return lambda sweeps: model([sweeps])


# What is compared: the two calls whose times are divided.
COMPARED: dict[str, tuple[Call, Call]] = {
    "`default` / `paper`, h = 0, equal region": (of(DEFAULT.replace(num_history=0)), of(WIDE)),
    "`default` / `paper`, h = 4, equal region": (of(DEFAULT), of(WIDE_HISTORY)),
    "OpenCV loop / `default`, h = 4, equal region and scales": (partial(opencv_flow, config=WIDE_SCALES), of(DEFAULT)),
    "OpenCV loop / `paper`, h = 0": (partial(opencv_flow, config=PAPER), of(PAPER)),
    "OpenCV loop / `paper`, h = 4, five scales": (partial(opencv_flow, config=FULL), of(FULL)),
    "`keypoints` / `paper`, h = 0": (of(KEYS), of(PAPER)),
}
COUNTED = {"`paper`": PAPER, "`default`": DEFAULT}


def times(sweeps: Window, repeats: int) -> Rows:
    """Ratio of the times of two calls, the median over neighbouring runs: a slow spell of the machine hits both."""
    for name, calls in COMPARED.items():
        seconds: list[list[float]] = [[], []]
        for repeat in range(-1, repeats):
            for call, taken in zip(calls, seconds):
                call(sweeps)  # the second of two runs counts
                start = time.perf_counter()
                call(sweeps)
                if repeat >= 0:
                    taken.append(time.perf_counter() - start)
        ms = "{:.1f} and {:.1f}".format(*(1000 * statistics.median(each) for each in seconds))
        yield {"what": name, "is": statistics.median(a / b for a, b in zip(*seconds)), "ms": ms}


def counts(sweeps: Window) -> Rows:
    """Launches and waits of a window on a simulated accelerator, and launches of sixteen windows over those of one."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))
    import pretend_device

    for name, config in COUNTED.items() if pretend_device.IS_THERE else ():
        with pretend_device.PretendDevice() as device:
            model = make_model(config, pretend_device.DEVICE)
            model([sweeps])
            one, sixteen = (device.count(partial(model, [sweeps] * number)) for number in (1, 16))
        yield {"what": f"launches / waits of a window, {name}", "is": "{} / {}".format(*one)}
        yield {"what": f"launches of 16 windows / one, {name}", "is": sixteen[0] / one[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", nargs="?", help="a log or a folder of logs; default: a simulated street")
    parser.add_argument("--repeats", type=int, default=20)
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    log: Log = make_drive(seed=7, num_sweeps=HISTORY + 2, profile="av2")
    if given.path:
        data_set = recognise(given.path)
        log = open_log(data_set, find_sources(data_set, given.path)[0], check=False)
    sweeps = window(log, min(HISTORY, len(log) - 2), HISTORY)
    print({**versions(), **machine(), "points": len(sweeps.pc0.points), "older_sweeps": len(sweeps.pch)}, flush=True)
    print(markdown([*times(sweeps, given.repeats), *counts(sweeps)]))


if __name__ == "__main__":
    main()
