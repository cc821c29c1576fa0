"""Write any log as a folder of point clouds with poses, times and ground masks, which `ArraysLog` reads."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Mapping, NamedTuple

import numpy as np

from cflow_torch.data.arrays.cloud_file import SUFFIXES, in_single, write_cloud
from cflow_torch.data.arrays.folder import GROUND_FOLDER
from cflow_torch.data.arrays.poses_text import write_kitti_poses, write_times
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.atomic import new_folder
from cflow_torch.data.log import Log
from cflow_torch.data.paths import stem_of
from cflow_torch.transforms import to_quaternions, transform_points
from cflow_torch.types import CFlowError, Sweep

POINTS_FOLDER = "points"


class SweepSides(NamedTuple):
    """What a folder has of a sweep besides its cloud, as in `Sweep`."""

    pose: Any
    timestamp_ns: int | None
    is_ground: Any

    @classmethod
    def of(cls, sweep: Sweep) -> SweepSides:
        return cls(sweep.pose, sweep.timestamp_ns, sweep.is_ground)


def write_array_log(log: Log, root: str | Path, suffix: str = ".npy", viewpoint: str | None = None) -> Path:
    """Write a log to `root/<log_id>`: `points/000000.npy` ..., `ground/000000.npy` ..., `poses.txt`, `times.txt`.

    Args:
        log: any log.
        root: parent folder, created if it does not exist.
        suffix: suffix of the clouds, one of `cloud_file.SUFFIXES`.
        viewpoint: "sensor" or "world" = write poses in VIEWPOINT of `.pcd` files, not in `poses.txt`, and points in
            this frame, as tools for dynamic maps expect; None = `poses.txt`.

    Returns:
        The folder.

    Convention:
        The folder appears complete or not at all. Clouds have the numbers of their sweeps in the data set
        (`Log.frame_number`), so missing sweeps stay missing; those of a folder of clouds keep their names. Points are
        in the log's ego frame, poses `T_world_ego` with 12 numbers per line (KITTI). We write poses, times and masks if
        every sweep has them, and the other columns of each cloud.

    Raises:
        CFlowError: an unknown suffix, poses of only some sweeps, or the folder exists; a `viewpoint` without poses, or
            with another suffix than `.pcd`.
    """
    if viewpoint not in (None, "sensor", "world") or (viewpoint and suffix != ".pcd"):
        raise CFlowError(f"viewpoint={viewpoint!r} with suffix={suffix!r}: pass 'sensor' or 'world' with .pcd, or None")
    if suffix not in SUFFIXES:
        raise CFlowError(f"suffix={suffix!r}: pass one of {', '.join(SUFFIXES)}")
    names = cloud_names(log)
    sides = {}
    with new_folder(root, log.log_id) as folder:
        for index, name in enumerate(names):
            sweep = log.sweep(index)
            write_sweep(folder / POINTS_FOLDER / f"{name}{suffix}", log, index, sweep, viewpoint)
            sides[name] = SweepSides.of(sweep)
        write_sides(folder, log.log_id, sides, has_viewpoints=viewpoint is not None)
    return Path(root) / log.log_id


def cloud_names(log: Log) -> list[str]:
    """Return the names of the clouds of a log, without a suffix: those of its files, or their numbers.

    Two equal ones are a `CFlowError`.
    """
    own = log.unwrapped
    if isinstance(own, ArraysLog):
        names = [stem_of(file) for file in own.files]
    else:
        names = [f"{log.frame_number(index):06d}" for index in range(len(log.timestamps))]
    if len({*names}) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise CFlowError(f"log {log.log_id}: two of its sweeps have the number {twice}")
    return names


def write_sweep(file: Path, log: Log, index: int, sweep: Sweep, viewpoint: str | None) -> None:
    """Write the points and the other columns of sweep `index`; `viewpoint` as in `write_array_log`."""
    points = np.asarray(sweep.points)[:, :3]
    where = None
    if viewpoint is not None:  # x, y, z and quaternion w, x, y, z of the pose
        if sweep.pose is None:
            raise CFlowError(f"log {log.log_id}: sweep {index} has no pose for VIEWPOINT; pass viewpoint=None")
        pose = np.asarray(sweep.pose, np.float64)
        where = [*pose[:3, 3].tolist(), *to_quaternions(pose[None, :3, :3])[0].tolist()]
    if viewpoint == "world":
        points = in_single(transform_points(points, np.asarray(sweep.pose)))
    write_cloud(file, points, log.columns(index), where)


def write_sides(folder: Path, log_id: str, sides: Mapping[str, SweepSides], has_viewpoints: bool) -> None:
    """Write ground masks, times and, unless clouds have viewpoints, poses of the sweeps, named as their clouds."""
    poses, times, masks = zip(*sides.values())
    if all(mask is not None for mask in masks):
        (folder / GROUND_FOLDER).mkdir()
        for name, mask in zip(sides, masks):
            np.save(folder / GROUND_FOLDER / f"{name}.npy", np.asarray(mask))
    if all(time is not None for time in times):
        write_times(folder / "times.txt", times)
    has_pose = [pose is not None for pose in poses]
    if any(has_pose) and not all(has_pose):
        raise CFlowError(f"log {log_id} has no pose of sweep {has_pose.index(False)}: give all poses or none")
    if all(has_pose) and not has_viewpoints:
        write_kitti_poses(folder / "poses.txt", np.stack(poses))
