"""Compare `CleanLog` with DUFOMap in removing moving points, on simulated drives and on real scenes.

python scripts/benchmarks/clean_maps.py
python scripts/benchmarks/clean_maps.py --only --root data/kitti-0000 --logs kitti-0000-c2

Scores per point, in per cent, as in DynamicMap_Benchmark: static accuracy SA (share of the static points that are
kept), dynamic accuracy DA (share of the moving points that are removed), AA = sqrt(SA DA). A point moves if its true
residual flow is at least 0.05 m per sweep. "Waiting" is the share of removed points of objects that are static now and
move elsewhere in the drive; SA and DA leave them out. Ground is scored. We score points within 50 m in all sweeps but
the last, in real scenes those with labels. Times are processor seconds per sweep, one thread, flow included.

DUFOMap (pip install dufomap; optional): 0.1 m, d_s 0.2, d_p 2 and 1, clusters and propagation, rays from the LiDAR (the
first one of several), points of 2 ... 50 m (with others it finds no moving point on KITTI).

The case "light" has a car that brakes and stops, and a car that starts up; its sensor is av2.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any, Iterator

import numpy as np
import torch
from labels import RANGE, dufomap_labels
from table import markdown
from tracks import SimulatedLog

from cflow_torch import make_config, make_model
from cflow_torch.applications.cleaning import CleanLog
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.catalog import find_sources, open_log, recognise
from cflow_torch.data.log import CachedLog, Log, window
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import Route
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.scene import Scene

DUFO = {"d_p 2": (0.1, 0.2, 2), "d_p 1": (0.1, 0.2, 1)}


def truths(log: Any) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each sweep but the last, three masks of its points: scored, moving now, moving at some time."""
    for index in range(len(log.timestamps) - 1):
        sweep = log.sweep(index)
        points = np.asarray(sweep.points, np.float64)[:, :3]
        if hasattr(log, "truth"):
            labels = log.drive.labels(index * log.step)
            body, velocity = log.truth(index)
            is_static = np.array([body.is_static for body in log.drive.scene.bodies] + [True])
            seconds = (log.timestamps[index + 1] - log.timestamps[index]) * 1e-9
            moves, known = (np.linalg.norm(velocity, axis=1) * seconds >= MOVING)[body], labels.is_valid
            ever = ~is_static[body]
        else:
            labels = log.labels(index)
            pose_flow = ego_motion_flow(points, np.linalg.inv(log.sweep(index + 1).pose) @ sweep.pose)
            moves = np.linalg.norm(labels.flow - pose_flow, axis=1) >= MOVING
            ever, known = moves, labels.is_valid
        yield known & (np.hypot(points[:, 0], points[:, 1]) < RANGE), moves, ever


def light(num_sweeps: int) -> SimulatedLog:
    """A car that stops after half of the sweeps, a car that starts up then, a parked car, houses."""
    rng, half = np.random.default_rng(0), 0.05 * num_sweeps
    routes = (
        Route(16, 3.5, math.pi, speed=3 * half, acceleration=-3),
        Route(8, -3.5, speed=-3 * half, acceleration=3),
        Route(4, 6, speed=0),
    )
    walls = (objects.wall(10, y, 60, 6, 8) for y in (12, -12))
    bodies = (*(objects.car(rng, route) for route in routes), *walls)
    scene = Scene(Ground((0.0, 0.0), 0.0), Route(-6, 0, speed=2), bodies)
    log = SimulatedLog("av2", 0, "street", num_sweeps)
    log.drive = Drive(scene, PROFILES["av2"], 0, num_sweeps, "light")
    return log


def scores(name: str, removed: list[np.ndarray], truth: list[Any], seconds: float) -> dict[str, Any]:
    """A row of the table."""
    total = np.zeros((3, 2))
    for is_removed, (is_scored, moves, ever) in zip(removed, truth):
        for row, chosen in enumerate((is_scored & ~moves & ~ever, is_scored & moves, is_scored & ~moves & ever)):
            total[row] += (is_removed & chosen).sum(), chosen.sum()
    static, dynamic, waiting = (100 * total[:, 0] / np.maximum(total[:, 1], 1)).tolist()
    kept = 100 - static
    return {
        "what": name,
        "SA": kept,
        "DA": dynamic,
        "AA": float(np.sqrt(kept * dynamic)),
        "waiting": float(waiting) if total[2, 1] else "",
        "seconds": seconds,
    }


def main() -> None:
    """Simulate, estimate, clean, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="offline", help="preset")
    parser.add_argument("--only", nargs="*", default=("light", "av2", "nuscenes", "waymo"), help="sensors, light")
    parser.add_argument("--scene", default="crossing")
    parser.add_argument("--seed", type=int, default=300)
    parser.add_argument("--num-sweeps", type=int, default=20)
    parser.add_argument("--root", type=Path, help="real logs with labels and poses, in the frame of their LiDAR")
    parser.add_argument("--logs", nargs="*", help="which of them")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = make_model(make_config(given.model), "auto")
    cases: list[tuple[str, Any, Log, np.ndarray]] = []
    for sensor in given.only:
        is_light = sensor == "light"
        made = light(given.num_sweeps) if is_light else SimulatedLog(sensor, given.seed, given.scene, given.num_sweeps)
        cases.append((sensor, made, made.opened(), next(iter(made.drive.calibration.values()))))
    if given.root is not None:
        reader = recognise(given.root)
        real = [open_log(reader, source, check=False) for source in find_sources(reader, given.root)]
        cases += [(log.log_id, log, log, np.eye(4)) for log in real if not given.logs or log.log_id in given.logs]
    rows = []
    for name, log, opened, T_ego_lidar in cases:
        recent, pairs = CachedLog(opened, model.config.num_sweeps), range(len(opened.timestamps) - 1)
        truth = list(truths(log))
        for index in pairs:  # simulation and reading are not timed
            recent.sweep(index)
        flow, seconds = [], 0.0
        for index in pairs:
            sweeps = window(recent, index, model.config.num_history, model.config.num_future)
            begin = time.process_time()
            flow.append(model([sweeps])[0])
            seconds += time.process_time() - begin
        for label, remove_stopped in (("cflow", False), ("cflow, stopped", True)):
            begin = time.process_time()
            clean = CleanLog(opened, flow=flow.__getitem__, remove_stopped=remove_stopped)
            removed = [clean.moving(index) for index in pairs]
            spent = (seconds + time.process_time() - begin) / len(flow)
            rows.append(scores(f"{name}: {label}", removed, truth, spent))
            print(rows[-1], flush=True)
        try:
            for label, settings in DUFO.items():
                begin = time.process_time()
                labels = dufomap_labels(opened, T_ego_lidar, settings)
                spent = (time.process_time() - begin) / len(labels)
                rows.append(scores(f"{name}: DUFOMap, {label}", labels, truth, spent))
                print(rows[-1], flush=True)
        except ImportError as error:
            print(f"no DUFOMap: {error}", flush=True)
    print(markdown(rows))
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
