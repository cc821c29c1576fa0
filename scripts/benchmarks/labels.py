#!/usr/bin/env python3
"""Compare labels of moving points with DUFOMap and HDBSCAN, by which OpenSceneFlow makes them.

  python scripts/benchmarks/labels.py DATA/kitti-0000                   labelled HDF5 scenes, or folders of them
  python scripts/benchmarks/labels.py panda.h5 --sensor-height 1.46     the LiDAR is above the origin of the points
  python scripts/benchmarks/labels.py --simulated av2 waymo             simulated drives
  pip install dufomap hdbscan h5py                                      else only our columns

docs/applications.md explains the columns. A point moves if its true residual flow is at least 0.05 m per sweep. DUFOMap
follows rays from the LiDAR, so its place must be right; settings are those of OpenSceneFlow's process.py. Times are
processor seconds per sweep on one thread, without reading and writing, medians over the scenes of a row.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from pathlib import Path
from typing import Any, Sequence

import numpy as np
import torch
from labelled import open_scenes, true_residual
from scipy import spatial  # noqa: F401 (its import is not timed)
from table import markdown

from cflow_torch import make_config, make_model
from cflow_torch.applications.labels import find_labels
from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.catalog import open_log
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.data.log import CachedLog, Log, window, windows
from cflow_torch.simulator.benchmark import benchmark_logs
from cflow_torch.transforms import transform_points

sys.path.append(str(Path(__file__).resolve().parents[2] / "tests"))
from writers import FORMATS  # noqa: E402

RANGE = 50.0  # metres
TIMED = 4  # about so many sweeps of a scene are grouped by HDBSCAN, only for its time
DRIVES = ((300, "street"), (301, "highway"))  # settings were chosen on 100 to 103
NUM_SWEEPS = 8  # of a simulated drive


def dufomap_labels(log: Log, T_points_lidar: np.ndarray, settings: tuple[float, float, int]) -> list[np.ndarray]:
    """Find the dynamic points of every sweep, (N,) bool, by DUFOMap with clusters and propagation.

    The map takes points of 2 ... 50 m from the LiDAR. The settings are side of a voxel in metres, d_s in metres, d_p in
    voxels.
    """
    from dufomap import dufomap

    sweeps, to_lidar = list(log), np.linalg.inv(T_points_lidar)
    points = [transform_points(sweep.points, to_lidar) for sweep in sweeps]
    poses = [np.linalg.inv(sweeps[0].pose) @ sweep.pose @ T_points_lidar for sweep in sweeps]
    found = dufomap(*settings, num_threads=1)
    found.setCluster(0, 20, 0.2)
    for cloud, pose in zip(points, poses):
        distance = np.linalg.norm(cloud, axis=1)
        found.run(cloud[(distance > 2) & (distance < RANGE)], pose, cloud_transform=True)
    found.oncePropagateCluster(if_cluster=True, if_propagate=True)
    return [np.asarray(found.segment(cloud, pose, cloud_transform=True)) > 0 for cloud, pose in zip(points, poses)]


def theirs(log: Log, height: float) -> dict[str, dict[str, Any]]:
    """Label a scene by DUFOMap, and group points by HDBSCAN; empty if a package is missing."""
    try:
        import dufomap  # noqa: F401
        from hdbscan import HDBSCAN
    except ImportError as error:
        print(f"only our labels: {error}", file=sys.stderr)
        return {}
    T_points_lidar = np.eye(4)
    T_points_lidar[2, 3] = height
    begin = time.process_time()
    labels = dufomap_labels(log, T_points_lidar, (0.15, 0.2, 1))
    seconds = (time.process_time() - begin) / len(log)
    labels = [found & ~sweep.is_ground for found, sweep in zip(labels, log)]
    settings = {"min_cluster_size": 20, "cluster_selection_epsilon": 0.7, "core_dist_n_jobs": 1}
    begin, chosen = time.process_time(), range(0, len(log), max(1, len(log) // TIMED))
    for index in chosen:
        sweep = log.sweep(index)
        HDBSCAN(alpha=1.1, **settings).fit_predict(sweep.points[~sweep.is_ground])
        if labels[index].sum() >= 20:
            HDBSCAN(**settings).fit_predict(sweep.points[labels[index]])
    grouping = (time.process_time() - begin) / len(chosen)
    return {"DUFOMap": {"seconds": seconds, "hdbscan": grouping, "counts": counts(log, labels)}}


def ours(log: Log, preset: str) -> dict[str, Any]:
    model = make_model(make_config(preset), "cpu")
    model([window(log, 0)])
    begin = time.process_time()
    flows = (model([w])[0] for w in windows(log, model.config.num_history, model.config.num_future))
    labels = [each["dufo"] > 0 for _, each in find_labels(log, flows, model)]
    return {"seconds": (time.process_time() - begin) / len(log), "counts": counts(log, labels)}


def counts(log: Log, labels: Sequence[np.ndarray]) -> list[int]:
    """Numbers of true positive, false positive and false negative points; true positive and false negative walkers."""
    total = np.zeros(5, np.int64)
    for index, found in enumerate(labels):
        truth, sweep = log.labels(index), log.sweep(index)
        if truth is None:
            continue
        is_scored = truth.is_valid & ~sweep.is_ground & (np.linalg.norm(sweep.points[:, :2], axis=1) <= RANGE)
        moves = is_scored & (np.linalg.norm(true_residual(log, index), axis=1) >= MOVING)
        walks = moves & (truth.category == CATEGORY_INDEX["PEDESTRIAN"])
        masks = (found & moves, found & is_scored & ~moves, ~found & moves, found & walks, ~found & walks)
        total += [mask.sum() for mask in masks]
    return total.tolist()


def simulated(sensor: str) -> list[Log]:
    """Simulated drives of a sensor, read with the reader of its data set."""
    made, logs = FORMATS[sensor], []
    for seed, scene in DRIVES:
        (source,) = benchmark_logs("outputs/cache", sensor, [seed], NUM_SWEEPS, [scene], made)
        logs.append(open_log(made.data_set, source, check=False, **made.settings))
    return logs


def table_row(name: str, scenes: list[dict[str, dict[str, Any]]]) -> dict[str, Any]:
    row: dict[str, Any] = {"scenes": f"{name} ({len(scenes)})"}
    for method in scenes[0]:
        results = [scene[method] for scene in scenes]
        found, false, missed, walkers, missed_walkers = np.sum([each["counts"] for each in results], 0)
        pairs = ((found, false), (found, missed), (walkers, missed_walkers))  # precision, recall, that of pedestrians
        row[method] = ", ".join(f"{part / (part + rest):.3f}" if part + rest else "–" for part, rest in pairs)
        row[f"{method}, s"] = f"{statistics.median(each['seconds'] for each in results):.2f}"
        if "hdbscan" in results[0]:
            row["+ HDBSCAN, s"] = f"{statistics.median(each['hdbscan'] for each in results):.2f}"
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", type=Path, nargs="*", help="labelled HDF5 scenes, or folders of them")
    parser.add_argument("--sensor-height", type=float, default=0.0, help="metres of the LiDAR above the points' origin")
    parser.add_argument("--simulated", nargs="*", default=[], choices=tuple(FORMATS), metavar="SENSOR")
    given = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, list[Log]] = {f"simulated {sensor}": simulated(sensor) for sensor in given.simulated}
    rows.update({log.log_id: [log] for log in open_scenes(given.paths)})
    table = []
    for name, logs in rows.items():
        scenes = []
        for log in logs:
            cached = CachedLog(log, len(log))
            list(cached)  # reads the sweeps before a clock starts
            own = {preset: ours(cached, preset) for preset in ("offline", "default")}
            scenes.append({**own, **theirs(cached, given.sensor_height)})
        table.append(table_row(name, scenes))
    print(markdown(table))


if __name__ == "__main__":
    main()
