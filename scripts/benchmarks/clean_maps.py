"""Compare `CleanLog` with DUFOMap in removing moving points, on simulated drives and on real scenes.

python scripts/benchmarks/clean_maps.py light av2 nuscenes waymo                  simulated: a crossing, or "light"
python scripts/benchmarks/clean_maps.py DATA/kitti-0000/kitti-0000-c2.h5          labelled HDF5 scenes

The scores SA, DA and AA are those of DynamicMap_Benchmark; docs/applications.md explains them. A point moves if its
true residual flow is at least 0.05 m per sweep. SA and DA leave waiting points out. Ground is scored. We score points
within 50 m in all sweeps but the last, in real scenes those with labels. Times are processor seconds per sweep, one
thread, flow included.

DUFOMap (pip install dufomap; optional): 0.1 m, d_s 0.2, d_p 2 and 1, clusters and propagation, rays from the LiDAR (the
first one of several), points of 2 ... 50 m (with others it finds no moving point on KITTI).

The case "light" has two cars that brake and stop, one of them in reverse; its sensor is av2.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any, Sequence

import numpy as np
import torch
from labelled import SENSORS, LabelledLog, SimulatedLog
from labels import RANGE, dufomap_labels
from table import markdown

from cflow_torch import make_config, make_model
from cflow_torch.applications.cleaning import CleanLog
from cflow_torch.data.catalog import GroundSegmentedLog
from cflow_torch.data.log import CachedLog, windows
from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.trajectories import Route

SEED = 300
DUFO = {"d_p 2": (0.1, 0.2, 2), "d_p 1": (0.1, 0.2, 1)}


def light(num_sweeps: int) -> SimulatedLog:
    """Two cars that stop after half of the sweeps, one of them in reverse, a parked car, houses."""
    rng, half = np.random.default_rng(0), 0.05 * num_sweeps
    routes = (
        Route(16, 3.5, math.pi, speed=3 * half, acceleration=-3),
        Route(8, -3.5, speed=-3 * half, acceleration=3),
        Route(4, 6, speed=0),
    )
    walls = (objects.wall(10, y, 60, 6, 8) for y in (12, -12))
    bodies = (*(objects.car(rng, route) for route in routes), *walls)
    scene = Scene(Ground((0.0, 0.0), 0.0), Route(-6, 0, speed=2), bodies)
    return SimulatedLog("av2", 0, "", num_sweeps, Drive(scene, PROFILES["av2"], 0, num_sweeps, "light"))


def scores(name: str, log: Any, removed: Sequence[np.ndarray], seconds: float) -> dict[str, Any]:
    total = np.zeros((3, 2))
    for index, is_removed in enumerate(removed[: len(log) - 1]):
        truth, points = log.truth(index), np.asarray(log.sweep(index).points)
        is_scored = truth.is_known & (np.hypot(points[:, 0], points[:, 1]) < RANGE)
        waits = is_scored & ~truth.moves & truth.moves_sometimes
        for row, chosen in enumerate((is_scored & ~truth.moves & ~waits, is_scored & truth.moves, waits)):
            total[row] += (is_removed & chosen).sum(), chosen.sum()
    static, dynamic, waiting = (100 * total[:, 0] / np.maximum(total[:, 1], 1)).tolist()
    accuracy = {"SA": 100 - static, "DA": dynamic, "AA": float(np.sqrt((100 - static) * dynamic))}
    return {"what": name, **accuracy, "waiting": float(waiting) if total[2, 1] else "", "seconds": seconds}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", nargs="*", default=("light", "av2", "nuscenes", "waymo"), help="sensors, light, files")
    parser.add_argument("--num-sweeps", type=int, default=20, help="of a simulated drive")
    given = parser.parse_args()
    torch.set_num_threads(1)
    model, rows = make_model(make_config("offline"), "auto"), []
    for name in given.logs:
        if name in SENSORS or name == "light":
            log = light(given.num_sweeps) if name == "light" else SimulatedLog(name, SEED, "crossing", given.num_sweeps)
            T_ego_lidar = next(iter(log.drive.calibration.values()))
        else:
            log, T_ego_lidar = LabelledLog(name), np.eye(4)
        opened = CachedLog(GroundSegmentedLog(log), len(log))
        list(opened)  # simulates or reads the sweeps before a clock starts
        begin = time.process_time()
        flow = [model([each])[0] for each in windows(opened, model.config.num_history, model.config.num_future)]
        seconds = time.process_time() - begin
        for label, remove_stopped in (("cflow", False), ("cflow, stopped", True)):
            begin = time.process_time()
            clean = CleanLog(opened, flow=flow.__getitem__, remove_stopped=remove_stopped)
            removed = [clean.moving(index) for index in range(len(flow))]
            spent = (seconds + time.process_time() - begin) / len(flow)
            rows.append(scores(f"{name}: {label}", log, removed, spent))
        try:
            for label, settings in DUFO.items():
                begin = time.process_time()
                removed = dufomap_labels(opened, T_ego_lidar, settings)
                spent = (time.process_time() - begin) / len(removed)
                rows.append(scores(f"{name}: DUFOMap, {label}", log, removed, spent))
        except ImportError as error:
            print(f"no DUFOMap: {error}", flush=True)
    print(markdown(rows))


if __name__ == "__main__":
    main()
