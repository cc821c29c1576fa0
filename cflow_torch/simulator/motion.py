"""Poses of the ego vehicle, its LiDARs and all solids at any time during a sweep."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from cflow_torch.simulator.lidar import Returns
from cflow_torch.simulator.rolling import MovingSolids, Shots
from cflow_torch.simulator.scene import Scene
from cflow_torch.simulator.sensors import LidarProfile, SpinningLidar
from cflow_torch.transforms import transform_each

_NUM_INTERVALS = 4  # per sweep; poses are interpolated within each, element by element: legs are exact to 0.3 mm
_DERIVATIVE_STEP = 1e-3  # half the interval of central differences, seconds


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

    def radial_velocity(self, seconds: float, returns: Returns) -> np.ndarray:
        """(N,) float32 m/s, speed over ground along each ray of the surface that it hit; positive = receding."""
        row_of_hit = np.append(self._row, -1)[returns.solid.numpy()]
        velocity = np.zeros(len(row_of_hit), np.float32)
        rows = np.flatnonzero(row_of_hit >= 0)
        if not len(rows):
            return velocity
        row_of_hit = row_of_hit[rows]
        shot: np.ndarray = np.full(len(rows), seconds)
        if self._profile.is_rolling:
            shot = seconds + 1e-9 * returns.offset_ns.numpy()[rows].astype(np.float64)
            slope = self._slopes_at(self._knots(seconds), shot, row_of_hit)
        else:
            slope = self._slopes(shot[:1])[0, row_of_hit]
        sensor, point = self._ray_ends(seconds, shot, returns, rows)
        ray = (point - sensor) / np.linalg.norm(point - sensor, axis=1, keepdims=True)
        at_point = transform_each(point, slope)
        velocity[rows] = (at_point * ray).sum(1)
        return velocity

    def _slopes(self, seconds: np.ndarray) -> np.ndarray:
        """Return (T, M, 3, 4) float64: linear functions from world positions to velocities of M dynamic solids.

        The velocity of a point on a rigid solid is such a function of the position of the point.
        """
        around = np.add.outer(seconds, (-_DERIVATIVE_STEP, 0.0, _DERIVATIVE_STEP)).ravel()
        bodies = self._dynamic.body_poses(around)
        poses = np.stack([self._dynamic.solids(t, p).pose.numpy() for t, p in zip(around.tolist(), bodies)])
        before, now, after = poses.reshape(len(seconds), 3, *poses.shape[1:]).swapaxes(0, 1)
        return (after - before)[..., :3, :] / (2 * _DERIVATIVE_STEP) @ np.linalg.inv(now)

    def _slopes_at(self, knots: np.ndarray, shot: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Interpolate `_slopes` between knots: (n, 3, 4) of the solids (n,) at the times of shots (n,)."""
        slopes = self._slopes(knots)
        position = (shot - knots[0]) / (knots[1] - knots[0])
        first = np.clip(np.floor(position).astype(int), 0, len(knots) - 2)
        weight = (position - first)[:, None, None]
        return (1 - weight) * slopes[first, row] + weight * slopes[first + 1, row]

    def _ray_ends(
        self, seconds: float, shot: np.ndarray, returns: Returns, rows: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) float64 each: world positions of the LiDAR at its shots, and of the points that they hit."""
        profile = self._profile
        stamped = self.ego_poses(np.array([seconds]))[0]
        unit = returns.unit.numpy()[rows]
        is_virtual = np.array([u.is_virtual for u in profile.units])[unit]
        ego = self.ego_poses(shot)
        ego[is_virtual] = stamped
        mounts = np.stack([u.T_ego_sensor for u in profile.units])
        sensor = transform_each(mounts[unit, :3, 3], ego)
        if profile.is_deskewed:
            ego = np.broadcast_to(stamped, ego.shape)
        points = returns.points.numpy()[rows].astype(np.float64)
        return sensor, transform_each(points, ego)

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
