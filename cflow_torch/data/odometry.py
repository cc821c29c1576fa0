"""Poses estimated from the points by generalised ICP (extra `odometry`): for logs without poses or with wrong ones, or
to refine noisy ones.

Each sweep is aligned with the one before it, at first with far correspondences, then with near ones.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from tqdm import tqdm

from cflow_torch.data.log import Log, LogWrapper
from cflow_torch.errors import CFlowError, import_optional
from cflow_torch.transforms import relative_transform, rigid_transform
from cflow_torch.types import Sweep

_FEWEST_POINTS = 100
_FARTHEST = (4.0, 1.0, 0.5, 0.3)  # metres, of correspondences, one alignment after the other
_MAX_RANGE = 100.0  # metres
_VOXEL = 0.25  # metres, of the points that are aligned
_NUM_NEIGHBOURS = 10  # of a point, from which its covariance comes
_NEED = (
    "estimating poses from the points needs small_gicp (extra odometry): pip install small-gicp, or pass poses "
    "(for arrays T_ego1_ego0, for a folder poses.txt)"
)


class Odometry:
    """Estimates poses sweep by sweep; a missing package is a `CFlowError`.

    Convention: without poses, an alignment starts from the motion of the sweep before, and the first one from rest. All
        runs on one thread, so that the poses do not depend on the number of threads.

    Cost: 0.08 to 0.2 s per sweep on one core.

    Source: Segal et al., "Generalized-ICP", RSS 2009, as in the package small_gicp.
    """

    def __init__(self) -> None:
        self._gicp = import_optional("small_gicp", _NEED)
        self._newest: Any = None  # the points of the newest sweep, and the tree that searches them
        self._pose = np.eye(4)  # T_world_ego of the newest sweep
        self._T_ego1_ego0 = np.eye(4)  # from the sweep before to the newest one

    def next_pose(self, points: np.ndarray, name: str, T_ego1_ego0: np.ndarray | None = None) -> np.ndarray:
        """Return the (4, 4) float64 `T_world_ego` of the next sweep; the world is the ego frame of the first.

        Args:
            points: (N, 3+), metres. Ground points help, because they constrain height and tilt.
            name: name of the sweep, for the error message.
            T_ego1_ego0: (4, 4) from the sweep before to this one, from which the alignment starts. None = that of the
                sweep before.

        Raises:
            CFlowError: fewer than 100 finite points within 100 m.
        """
        points = points[:, :3].astype(np.float64)
        points = points[np.linalg.norm(points, axis=1) < _MAX_RANGE]  # NaN is not smaller
        if len(points) < _FEWEST_POINTS:
            raise CFlowError(f"{name} has fewer than {_FEWEST_POINTS} points within {_MAX_RANGE:g} m")
        prepared = self._gicp.preprocess_points(points, _VOXEL, _NUM_NEIGHBOURS, 1)
        if self._newest is not None:
            target, tree = prepared
            source, _ = self._newest
            motion = self._T_ego1_ego0 if T_ego1_ego0 is None else T_ego1_ego0
            for farthest in _FARTHEST:
                motion = self._gicp.align(
                    target,
                    source,
                    tree,
                    motion,
                    registration_type="GICP",
                    num_threads=1,
                    max_correspondence_distance=farthest,
                ).T_target_source
            self._T_ego1_ego0 = rigid_transform(motion, f"the estimated motion to {name}")
            self._pose = self._pose @ np.linalg.inv(self._T_ego1_ego0)
        self._newest = prepared
        return self._pose.copy()


def estimate_poses(log: Log, starts_from_poses: bool = True) -> np.ndarray:
    """Estimate (K, 4, 4) float64 `T_world_ego` of the sweeps of a log; the world is the ego frame of the first.

    If the sweeps have poses, each alignment starts from the motion between them. With `starts_from_poses=False`, their
    poses are ignored.
    Cost: reads all sweeps.
    """
    odometry = Odometry()
    poses = []
    given: Any = None  # pose of the sweep before
    for index in tqdm(range(len(log.timestamps)), desc="odometry", unit="sweep", disable=None):
        sweep = log.sweep(index)
        start = (
            None
            if given is None or sweep.pose is None or not starts_from_poses
            else relative_transform(sweep.pose, given)
        )
        poses.append(odometry.next_pose(np.asarray(sweep.points), f"sweep {index} of log {log.log_id}", start))
        given = sweep.pose
    return np.stack(poses)


class PosedLog(LogWrapper):
    """A log with other poses, (K, 4, 4) float64 `T_world_ego`, one per sweep; `are_estimated` = by `estimate_poses`."""

    def __init__(self, log: Log, poses: np.ndarray, are_estimated: bool = False) -> None:
        super().__init__(log)
        self.has_estimated_poses = are_estimated
        self.poses = self._given = poses
        self.trajectory = None

    def sweep(self, index: int) -> Sweep:
        return replace(self.log.sweep(index), pose=self._given[index].copy())


def with_poses(log: Log, refine: bool = False) -> Log:
    """Return a log with poses estimated from its points, which replace its own. With `refine`, we start from those."""
    return PosedLog(log, estimate_poses(log, refine), are_estimated=True)
