"""Compare `CleanLog` with DUFOMap and `dynamic-object-removal` in removing moving points.

python scripts/benchmarks/clean_maps.py light av2 nuscenes waymo                  simulated: a crossing, or "light"
python scripts/benchmarks/clean_maps.py DATA/kitti-0000/kitti-0000-c2.h5          labelled HDF5 scenes

The scores SA, DA and AA are those of DynamicMap_Benchmark; docs/applications.md explains them. A point moves if its
true residual flow is at least 0.05 m per sweep. SA and DA leave waiting points out. Ground is scored. F1 is that of
moving points, without ground. We score points within 50 m in all sweeps but the last, in real scenes those with labels.
Times are processor seconds per sweep, one thread, flow included.

DUFOMap (pip install dufomap; optional): 0.1 m, d_s 0.2, d_p 2 and 1, clusters and propagation, rays from the LiDAR (the
first one of several), points of 2 ... 50 m (with others it finds no moving point on KITTI).

dynamic-object-removal (pip install dynamic-object-removal; optional): its algorithm `fusion`, its best one, with its
preset short-window. Its defaults are for 100 sweeps or more.

The case "light" has two cars that brake and stop, one of them in reverse; its sensor is av2.
"""

from __future__ import annotations

import argparse
import math
import time
from typing import Any, Callable, Mapping, Sequence

import numpy as np
import torch
from beams import SENSOR_HEIGHT
from labelled import SENSORS, LabelledLog, SimulatedLog
from labels import RANGE, dufomap_labels
from table import markdown

from cflow_torch import make_config, make_model
from cflow_torch.applications.cleaning import CleanLog
from cflow_torch.data.catalog import GroundSegmentedLog
from cflow_torch.data.log import CachedLog, Log, windows
from cflow_torch.simulator import objects
from cflow_torch.simulator.drive import Drive
from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.profiles import PROFILES
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.trajectories import Route
from cflow_torch.transforms import transform_points

SEED = 300
DUFO = {"d_p 2": (0.1, 0.2, 2), "d_p 1": (0.1, 0.2, 1)}


FUSION: dict[str, dict[str, Any]] = {
    "short-window": {"free_votes_fraction": 0.7, "free_votes_floor": 3, "void_min_scans": 4},
}


def fusion_labels(log: Log, T_ego_lidar: np.ndarray, settings: Mapping[str, Any]) -> list[np.ndarray]:
    """Find the dynamic points of every sweep, (N,) bool, by the algorithm `fusion` of dynamic-object-removal."""
    from dynamic_object_removal import clean_map_by_fusion

    to_start = np.linalg.inv(log.sweep(0).pose)
    poses = [to_start @ sweep.pose for sweep in log]
    clouds = [transform_points(sweep.points, pose) for sweep, pose in zip(log, poses)]
    scans = [(cloud, (pose @ T_ego_lidar)[:3, 3]) for cloud, pose in zip(clouds, poses)]
    _, is_kept = clean_map_by_fusion(np.concatenate(clouds), scans, **settings)
    return np.split(~is_kept, np.cumsum([len(cloud) for cloud in clouds])[:-1])


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


def scores(name: str, log: Any, opened: Log, removed: Sequence[np.ndarray], seconds: float) -> dict[str, Any]:
    total = np.zeros((3, 2))
    counts = np.zeros(3)  # moving points without ground: true, removed, both
    for index, is_removed in enumerate(removed[: len(log) - 1]):
        truth, points = log.truth(index), np.asarray(log.sweep(index).points)
        is_scored = truth.is_known & (np.hypot(points[:, 0], points[:, 1]) < RANGE)
        waits = is_scored & ~truth.moves & truth.moves_sometimes
        ground = opened.sweep(index).is_ground
        chosen = is_scored & ~waits if ground is None else is_scored & ~waits & ~np.asarray(ground)
        moves, removes = truth.moves[chosen], is_removed[chosen]
        counts += moves.sum(), removes.sum(), (moves & removes).sum()
        for row, chosen in enumerate((is_scored & ~truth.moves & ~waits, is_scored & truth.moves, waits)):
            total[row] += (is_removed & chosen).sum(), chosen.sum()
    true, predicted, both = counts.tolist()
    static, dynamic, waiting = (100 * total[:, 0] / np.maximum(total[:, 1], 1)).tolist()
    accuracy = {"SA": 100 - static, "DA": dynamic, "AA": float(np.sqrt((100 - static) * dynamic))}
    accuracy["F1"] = 2 * both / max(true + predicted, 1)
    return {"what": name, **accuracy, "waiting": float(waiting) if total[2, 1] else "", "seconds": seconds}


# Function that returns the rows to remove from each sweep, and its modes.
OTHERS: dict[str, tuple[Callable[..., list[np.ndarray]], Mapping[str, Any]]] = {
    "DUFOMap": (dufomap_labels, DUFO),
    "dynamic-object-removal": (fusion_labels, FUSION),
}


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
            if log.log_id.startswith("panda"):
                T_ego_lidar[2, 3] = SENSOR_HEIGHT
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
            rows.append(scores(f"{name}: {label}", log, opened, removed, spent))
        for other, (labels_of, modes) in OTHERS.items():
            try:
                for label, settings in modes.items():
                    begin = time.process_time()
                    removed = labels_of(opened, T_ego_lidar, settings)
                    spent = (time.process_time() - begin) / len(removed)
                    rows.append(scores(f"{name}: {other}, {label}", log, opened, removed, spent))
            except ImportError as error:
                print(f"no {other}: {error}", flush=True)
    print(markdown(rows))


if __name__ == "__main__":
    main()
