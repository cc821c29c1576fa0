"""Ego motion estimated from the points by KISS-ICP (extra `odometry`), for logs without poses."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Sequence

import numpy as np
from tqdm import tqdm

from cflow_torch.data.log import Log, LogWrapper, points_surround_poses
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import Sweep

# KISS-ICP first assumes a static vehicle: its first steps are off by up to 14 cm at 6 m/s, later ones by 1 to 3 cm.
_RUN_IN = 5  # sweeps
_FEWEST_POINTS = 100
_NEED = (
    "there are no poses, and estimating them needs KISS-ICP (extra odometry): pip install kiss-icp, or pass poses "
    "(for arrays T_ego1_ego0, for a folder poses.txt)"
)
_MAX_RANGE = 100.0  # metres; KISS-ICP's own default, which also sets its voxel size (a hundredth)


def poses_from_odometry(log: Log) -> np.ndarray:
    """Estimate (K, 4, 4) float64 `T_world_ego` of the sweeps of a log; the world is the ego frame of the first.

    Poses of the sweeps are ignored. Ground points are used, because they constrain height and tilt.

    Convention: KISS-ICP runs with its default settings, but without de-skewing, and on one thread, so that the poses do
        not depend on their number. The first five steps are those of a second run, backwards from the eleventh sweep,
        because KISS-ICP needs a few sweeps to adapt to the speed.

    Cost: one registration per sweep and eleven more, 0.13 s each for 120,000 points; reads as many sweeps.

    Source: Vizzo et al., "KISS-ICP: In Defense of Point-to-Point ICP", RA-L 2023.
    """
    last = len(log.timestamps) - 1
    joint = min(_RUN_IN, last // 2)  # the sweep at which both runs are joined
    forward = _register(log, range(last + 1))
    backward = _register(log, range(min(2 * joint, last), -1, -1))[::-1]
    start = [np.eye(4)] + [np.linalg.inv(backward[0]) @ pose for pose in backward[1 : joint + 1]]
    to_world = start[joint] @ np.linalg.inv(forward[joint])
    return np.stack(start + [to_world @ pose for pose in forward[joint + 1 :]])


def _register(log: Log, order: Sequence[int]) -> list[np.ndarray]:
    """Return the poses of sweeps in the given order. The world is the ego frame of the first one in this order."""
    odometry = Odometry()
    return [
        odometry.next_pose(np.asarray(log.sweep(index).points), f"sweep {index} of log {log.log_id}")
        for index in tqdm(order, desc="odometry", unit="sweep", disable=None)
    ]


class Odometry:
    """KISS-ICP with the settings of `poses_from_odometry`, sweep by sweep; a missing package is a `CFlowError`."""

    def __init__(self) -> None:
        kiss_icp, configs = (import_optional(f"kiss_icp.{name}", _NEED) for name in ("kiss_icp", "config"))
        config = configs.load_config(None)
        config.data.deskew = False
        config.data.max_range = _MAX_RANGE
        config.mapping.voxel_size = _MAX_RANGE / 100
        config.registration.max_num_threads = 1
        self._odometry = kiss_icp.KissICP(config)

    def next_pose(self, points: np.ndarray, name: str) -> np.ndarray:
        """Return the (4, 4) float64 `T_world_ego` of the next sweep; the world is the ego frame of the first.

        `points` are (N, 3+), metres. Fewer than 100 finite ones within 100 m are a `CFlowError` that contains
        `name`, the name of the sweep.
        """
        points = points[:, :3].astype(np.float64)
        points = points[np.isfinite(points).all(1)]
        if (np.linalg.norm(points, axis=1) < _MAX_RANGE).sum() < _FEWEST_POINTS:
            raise CFlowError(f"{name} has fewer than {_FEWEST_POINTS} points within {_MAX_RANGE} m")
        self._odometry.register_frame(np.ascontiguousarray(points), np.zeros(len(points)))
        return rigid_transform(self._odometry.last_pose, f"the pose that KISS-ICP estimates for {name}")


class PosedLog(LogWrapper):
    """A log with other poses, (K, 4, 4) float64 `T_world_ego`, one per sweep."""

    def __init__(self, log: Log, poses: np.ndarray) -> None:
        super().__init__(log)
        self.poses = self._given = poses
        self.trajectory = None

    @cached_property
    def surrounds_poses(self) -> bool:
        return points_surround_poses(self)

    def sweep(self, index: int) -> Sweep:
        return replace(self.log.sweep(index), pose=self._given[index].copy())


def with_poses(log: Log) -> Log:
    """Return the log itself if its first sweep has a pose, else the log with `poses_from_odometry`."""
    return log if log.sweep(0).pose is not None else PosedLog(log, poses_from_odometry(log))
