#!/usr/bin/env python3
"""DUFOMap and HDBSCAN, by which OpenSceneFlow labels moving points (`pip install dufomap hdbscan h5py`), on one thread.

  python scripts/benchmarks/peers.py SCENE.h5 LABELS.npz      labels of a scene to a file; seconds a sweep, as JSON

Settings are those of OpenSceneFlow's process.py. Nothing of this package is needed.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Sequence

import numpy as np

RANGE = 50.0  # metres


def dufomap_labels(
    points: Sequence[np.ndarray], poses: Sequence[np.ndarray], settings: tuple[float, float, int]
) -> list[np.ndarray]:
    """Return the dynamic points, by DUFOMap with clusters and propagation.

    Args:
        points: (N, 3) metres, of each sweep in the frame of its LiDAR. Those of 2 ... 50 m are put in the map.
        poses: (4, 4) of each LiDAR in one frame.
        settings: side of a voxel in metres, d_s in metres, d_p in voxels.

    Returns:
        (N,) bool of each sweep.
    """
    from dufomap import dufomap

    found = dufomap(*settings, num_threads=1)
    found.setCluster(0, 20, 0.2)
    for sweep, pose in zip(points, poses):
        distance = np.linalg.norm(sweep, axis=1)
        found.run(sweep[(distance > 2) & (distance < RANGE)], pose, cloud_transform=True)
    found.oncePropagateCluster(if_cluster=True, if_propagate=True)
    return [np.asarray(found.segment(sweep, pose, cloud_transform=True)) > 0 for sweep, pose in zip(points, poses)]


def label_scene(file: str, labels: str) -> dict[str, float]:
    """DUFOMap and HDBSCAN on a scene: labels to a file, seconds a sweep of each."""
    import h5py
    from hdbscan import HDBSCAN

    with h5py.File(file, "r") as scene:
        groups = [scene[stamp] for stamp in sorted(scene, key=int)]
        extrinsics = scene.attrs.get("ego_T_lidar", np.eye(4))
        points = [group["lidar"][:, :3].astype(np.float32) for group in groups]
        ground = [group["ground_mask"][()].astype(bool) for group in groups]
        poses = [group["pose"][()].astype(np.float64) @ extrinsics for group in groups]
    poses = [np.linalg.inv(poses[0]) @ pose for pose in poses]
    start = time.process_time()
    dufo = [moves & ~is_ground for moves, is_ground in zip(dufomap_labels(points, poses, (0.15, 0.2, 1)), ground)]
    middle = time.process_time()
    settings = {"min_cluster_size": 20, "cluster_selection_epsilon": 0.7, "core_dist_n_jobs": 1}
    for sweep, is_ground, moves in zip(points, ground, dufo):
        HDBSCAN(alpha=1.1, **settings).fit_predict(sweep[~is_ground])
        if moves.sum() >= 20:
            HDBSCAN(**settings).fit_predict(sweep[moves])
    end = time.process_time()
    np.savez(labels, *dufo)
    return {"dufomap": (middle - start) / len(points), "hdbscan": (end - middle) / len(points)}


if __name__ == "__main__":
    print(json.dumps(label_scene(*sys.argv[1:])))
