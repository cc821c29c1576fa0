"""Poses of the ego vehicle, its LiDARs and all solids at any time during a sweep."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from cflow_torch.simulator.rolling import MovingSolids, Shots
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.sensors import LidarProfile, SpinningLidar

_NUM_INTERVALS = 4  # per sweep; poses are interpolated within each, element by element: legs are exact to 0.3 mm


class SceneMotion:
    """Motion of a scene, sweep by sweep.

    Args:
        scene: ground, ego vehicle and bodies.
        profile: mountings and shot times of the LiDARs.
        stamps: (S,) float64 seconds, time stamps of the sweeps.
    """

    def __init__(self, scene: Scene, profile: LidarProfile, stamps: np.ndarray) -> None:
        self._scene = scene
        self._profile = profile
        self._stamps = stamps
        self._dynamic, solids = scene.dynamic_part()
        body = scene.body_of_solid
        self._row = np.full(len(body), -1)
        self._row[solids] = np.arange(len(solids))
        self._static = scene.solids(0.0, scene.body_poses(np.zeros(1))[0])
        self._T_static_world = _inverse(self._static.pose.numpy())

    def ego_poses(self, seconds: np.ndarray) -> np.ndarray:
        """(T, 4, 4) float64 `T_world_ego` at `seconds` (T,)."""
        poses = self._scene.ground.pose(*self._scene.ego(seconds).T)
        poses[:, :3, 3] += self._profile.ego_height * poses[:, :3, 2]
        return poses

    def shots(self, unit: SpinningLidar, seconds: float, phase: float, origin: Tensor) -> Shots:
        """Shots of a LiDAR in the sweep with time stamp `seconds`.

        `phase`, 0 ... 1, shifts its columns, and `origin` is as in `MovingSolids`.
        """
        profile = self._profile
        interval = profile.sweep_interval_ns * 1e-9
        first, end = unit.active_columns or (0, unit.num_columns)
        times = seconds + interval * (np.arange(first, end) / unit.num_columns - profile.reference)
        # All shots of a virtual unit are taken from the pose at the time stamp.
        ego = self.ego_poses(np.full(len(times), seconds) if unit.is_virtual else times)
        T_world_sensor = torch.from_numpy(ego @ unit.T_ego_sensor)
        T_world_sensor[:, :3, 3] -= origin
        step = math.radians(unit.span) / unit.num_columns
        return Shots(
            azimuth=math.radians(unit.start) + step * (torch.arange(first, end).double() + phase),
            seconds=torch.from_numpy(times),
            T_world_sensor=T_world_sensor,
            elevation=torch.tensor(unit.elevations, dtype=torch.float64).deg2rad().sort().values,
            speed=(0.0, 0.0) if unit.is_virtual else self._speed(seconds),
        )

    def _speed(self, seconds: float) -> tuple[float, float]:
        """Bounds of the LiDARs' speed, m/s, and rotation rate, rad/s, for any time up to a second after `seconds`."""
        route = self._scene.ego
        speed = abs(route.speed) + abs(route.acceleration) * (seconds + 1)
        yaw_rate = speed * (1 / route.radius + abs(self._scene.ground.curvature))
        return 1.1 * speed + 6 * yaw_rate, 1.1 * yaw_rate

    @cached_property
    def _dynamic_poses(self) -> np.ndarray:
        """(S, K + 1, M, 4, 4) float64 poses of the dynamic bodies at the knots of all sweeps; cached: it is slow."""
        knots = np.stack([self._knots(stamp) for stamp in self._stamps.tolist()])
        poses = self._dynamic.body_poses(knots.ravel())
        return poses.reshape(*knots.shape, *poses.shape[1:])

    def solids(self, index: int) -> MovingSolids:
        """All solids during sweep `index`."""
        seconds = float(self._stamps[index])
        poses = self._dynamic_poses[index]
        knots = self._knots(seconds)
        origin = self.ego_poses(np.array([seconds]))[0, :3, 3]
        dynamic = np.stack([_inverse(self._dynamic.solids(t, p).pose.numpy()) for t, p in zip(knots.tolist(), poses)])
        static = self._static
        return MovingSolids(
            kind=static.kind,
            half_size=static.half_size,
            albedo=static.albedo,
            is_foliage=static.is_foliage,
            is_own=static.is_own,
            origin=torch.from_numpy(origin),
            knots=torch.from_numpy(knots),
            static=torch.from_numpy(_relative_to(self._T_static_world, origin)),
            row=torch.from_numpy(self._row),
            dynamic=torch.from_numpy(_relative_to(dynamic, origin)),
        )

    def _knots(self, seconds: float) -> np.ndarray:
        interval = self._profile.sweep_interval_ns * 1e-9
        return seconds + interval * (np.linspace(0, 1, _NUM_INTERVALS + 1) - self._profile.reference)


def _inverse(poses: np.ndarray) -> np.ndarray:
    """(..., 3, 4) inverse of rigid transforms (..., 4, 4)."""
    rotation = np.swapaxes(poses[..., :3, :3], -1, -2)
    return np.concatenate([rotation, -rotation @ poses[..., :3, 3:]], -1)


def _relative_to(transforms: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(..., 3, 4) the same transforms, for world coordinates relative to `origin` (3,)."""
    moved = transforms.copy()
    moved[..., 3] += transforms[..., :3] @ origin
    return moved
