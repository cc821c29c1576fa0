"""Write any log as a folder of point clouds with poses, times and ground masks, which `ArraysLog` reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cflow_torch.data.arrays.cloud_file import SUFFIXES, write_cloud
from cflow_torch.data.arrays.poses_text import write_kitti_poses, write_times, write_tum_poses
from cflow_torch.data.arrays.reader import GROUND_FOLDER
from cflow_torch.data.atomic import new_folder
from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError


def write_array_log(log: Log, root: str | Path, suffix: str = ".npy", poses: str | None = "kitti") -> Path:
    """Write a log to `root/<log_id>`: `points/000000.npy` ..., `ground/000000.npy` ..., `poses.txt`, `times.txt`.

    Args:
        log: any log.
        root: parent folder, created if it does not exist.
        suffix: of the clouds, one of `cloud_file.SUFFIXES`.
        poses: "kitti" (12 numbers per line), "tum" (with times), "npy" ((K, 4, 4) float64), None = none.

    Returns:
        The folder.

    Convention:
        The folder appears complete or not at all. Points are in the log's ego frame, poses `T_world_ego`. Masks and
        times are written if every sweep has them, and every cloud has the columns that the log has for it.

    Raises:
        CFlowError: an unknown suffix or format, poses requested but missing, or the folder exists.
    """
    if suffix not in SUFFIXES or poses not in ("kitti", "tum", "npy", None):
        allowed = f"one of {SUFFIXES} and 'kitti', 'tum', 'npy' or None"
        raise CFlowError(f"suffix={suffix!r}, poses={poses!r}: pass {allowed}")
    transforms, times, masks = [], [], []
    with new_folder(root, log.log_id) as folder:
        for index in range(len(log.timestamps)):
            sweep = log.sweep(index)
            points = np.asarray(sweep.points)[:, :3]
            write_cloud(folder / "points" / f"{index:06d}{suffix}", points, log.columns(index))
            transforms.append(sweep.pose)
            times.append(sweep.timestamp_ns)
            masks.append(sweep.is_ground)
        if all(mask is not None for mask in masks):
            (folder / GROUND_FOLDER).mkdir()
            for index, mask in enumerate(masks):
                np.save(folder / GROUND_FOLDER / f"{index:06d}.npy", np.asarray(mask))
        known = [time for time in times if time is not None]
        if len(known) == len(times):
            write_times(folder / "times.txt", known)
        if poses is not None:
            if any(pose is None for pose in transforms) or (poses == "tum" and len(known) < len(times)):
                raise CFlowError(f"log {log.log_id} has sweeps without pose or time; write it with poses=None")
            stacked = np.stack([np.asarray(pose, np.float64) for pose in transforms])
            if poses == "kitti":
                write_kitti_poses(folder / "poses.txt", stacked)
            elif poses == "tum":
                write_tum_poses(folder / "poses.txt", known, stacked)
            else:
                np.save(folder / "poses.npy", stacked)
    return Path(root) / log.log_id
