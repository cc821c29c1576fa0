"""Logs with the truth of every point and object: labelled HDF5 scenes and simulated drives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.applications.moving_groups import MOVING
from cflow_torch.data.hdf5 import HDF5Log, find_hdf5_scenes
from cflow_torch.data.log import Log
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.simulator import make_drive
from cflow_torch.simulator.drive import Drive
from cflow_torch.transforms import transform_each
from cflow_torch.types import Sweep

SENSORS = ("av2", "nuscenes", "truckscenes", "waymo", "aevascenes")
WITH_MASKS = ("av2", "aevascenes")  # sensors whose data sets have ground masks
RAW = ("truckscenes",)  # sensors whose points are in the ego frame at the instant of each one; the reader de-skews them


class Truth(NamedTuple):
    """Objects of one sweep."""

    object_id: np.ndarray  # (N,) int64 of each point, 0 = background
    is_known: np.ndarray  # (N,) bool, False = without label
    velocity: np.ndarray  # (objects, 3) over ground, m/s in the world, by id
    moves: np.ndarray  # (N,) bool, the true residual flow is at least 0.05 m per sweep
    moves_sometimes: np.ndarray  # (N,) bool, the object moves at some time of the drive


def true_residual(log: Log, index: int) -> np.ndarray:
    """(N, 3) true residual flow of a labelled sweep, metres per sweep, axes of the next sweep."""
    sweep, after = log.sweep(index), log.sweep(index + 1)
    return log.labels(index).flow - ego_motion_flow(sweep.points, np.linalg.inv(after.pose) @ sweep.pose)


class LabelledLog(HDF5Log):
    """A scene with labels and the ids of objects."""

    def truth(self, index: int) -> Truth:
        """Mean velocity of the labelled points of each object."""
        labels, residual = self.labels(index), true_residual(self, index)
        seconds = (self.timestamps[index + 1] - self.timestamps[index]) * 1e-9
        object_id = np.where(labels.is_valid, self.values(index, "flow_instance_id"), 0).astype(np.int64)
        count = np.bincount(object_id).clip(1)
        velocity = np.stack([np.bincount(object_id, each) / count for each in residual.T], 1) / seconds
        velocity[0] = 0
        moves = np.linalg.norm(residual, axis=1) >= MOVING
        return Truth(object_id, labels.is_valid, velocity @ self.sweep(index + 1).pose[:3, :3].T, moves, moves)


def open_scenes(paths: Sequence[Path]) -> list[LabelledLog]:
    """Open labelled HDF5 scenes, or all scenes of folders."""
    return [LabelledLog(file) for path in paths for file in find_hdf5_scenes(path)]


class SimulatedLog(Log):
    """A simulated drive with the sweep rate and ground masks of its data set, and with the truth."""

    def __init__(self, profile: str, seed: int, scene: str, num_sweeps: int, drive: Drive | None = None) -> None:
        self.step = 2 if profile == "nuscenes" else 1
        self._has_masks = profile in WITH_MASKS
        self._is_raw = profile in RAW
        self.drive = drive or make_drive(seed, num_sweeps * self.step, profile, scene)
        self.log_id, self.timestamps = self.drive.log_id, self.drive.timestamps[:: self.step]

    def sweep(self, index: int) -> Sweep:
        """Sweep of the drive as the reader of its data set gives it: de-skewed, and without its mask if it has none."""
        sweep = self.drive.sweep(index * self.step)
        if self._is_raw:
            poses = self.drive.poses_at(index * self.step, sweep.point_times * 1e9)
            points = transform_each(sweep.points.astype(np.float64), np.linalg.inv(sweep.pose) @ poses)
            sweep = replace(sweep, points=points.astype(np.float32))
        return sweep if self._has_masks else replace(sweep, is_ground=None)

    def truth(self, index: int) -> Truth:
        """Velocity of each body to the next sweep."""
        scene, times = self.drive.scene, (np.array(self.timestamps[index : index + 2]) - self.timestamps[0]) * 1e-9
        now, then = scene.body_poses(times)[:, :, :3, 3]
        distance = np.concatenate([np.zeros((1, 3)), then - now])
        solid = self.drive.returns(index * self.step).solid.numpy()
        body = np.append(scene.body_of_solid, len(now))[solid]
        object_id = np.where(body < len(now), body + 1, 0)
        moves, sometimes = np.linalg.norm(distance, axis=1) >= MOVING, [False, *(not b.is_static for b in scene.bodies)]
        of_points = moves[object_id], np.array(sometimes)[object_id]
        return Truth(object_id, np.ones(len(body), bool), distance / (times[1] - times[0]), *of_points)
