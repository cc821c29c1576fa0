"""A recording of a few points with known numbers, for tests of readers."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from cflow_torch.data.boxes import Boxes
from cflow_torch.data.categories import CATEGORY_INDEX
from cflow_torch.simulator.recording import UnitReturns
from cflow_torch.types import Sweep

START_NS = 1_533_279_682_000_000_000
NUM_STATIC, NUM_ON_CAR = 30, 10
CAR_SIZE = np.array([4.0, 2.0, 1.5])
CAR_VELOCITY = np.array([3.0, 20.0, 0.0])  # m/s, world
EGO_SPEED, EGO_YAW_RATE = 15.0, 0.3
TRACKS = ("5a1e3c1e-94a3-4f4c-8f1a-7a2b7f6b1c11", "0b0f6a43-6c53-4f39-9c49-1a1d6b1a2c22")


def turn_z(angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def rigid(rotation: np.ndarray, translation: Sequence[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation
    return pose


class TinyRecording:
    """Ego and one car move at constant velocity, the ego yaws at a constant rate; a second car is parked.

    Every shot has its own time, up to 99 ms after the sweep's time stamp, and is not compensated for any motion.
    `names` are those of the LiDARs, and `origin` is the world translation of the ego at the start, metres.
    """

    def __init__(
        self,
        names: tuple[str, ...] = ("LIDAR_LEFT", "LIDAR_RIGHT"),
        num_sweeps: int = 6,
        interval_ns: int = 100_000_000,
        origin: tuple[float, float, float] = (1000.0, 500.0, 0.0),
        log_id: str = "tiny",
    ) -> None:
        self.log_id = log_id
        self.timestamps = tuple(START_NS + i * interval_ns for i in range(num_sweeps))
        self._origin = np.array(origin)
        self.poses = np.stack([self.pose_at(stamp) for stamp in self.timestamps])
        rng = np.random.default_rng(0)
        self.mounts = {
            name: rigid(turn_z(rng.uniform(-3, 3)) @ np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.uniform(-2, 2, 3))
            for name in names
        }
        for mount in self.mounts.values():
            mount[:3, :3] *= np.sign(np.linalg.det(mount[:3, :3]))
        angle = rng.uniform(-np.pi, np.pi, (len(names), NUM_STATIC))
        distance = rng.uniform(20, 90, angle.shape)
        height = rng.uniform(0.5, 3, angle.shape)
        self._static = self._origin + np.stack([distance * np.cos(angle), distance * np.sin(angle), height], -1)
        self._on_car = rng.uniform(-0.45, 0.45, (len(names), NUM_ON_CAR, 3)) * CAR_SIZE
        count = NUM_STATIC + NUM_ON_CAR
        self._offset_us = np.stack([rng.permutation(np.linspace(0, 99_000, count).astype(np.int64)) for _ in names])

    def pose_at(self, time_ns: int) -> np.ndarray:
        seconds = (time_ns - START_NS) * 1e-9
        return rigid(turn_z(EGO_YAW_RATE * seconds), self._origin + [EGO_SPEED * seconds, 0, 0])

    def car_at(self, time_ns: int) -> np.ndarray:
        seconds = (time_ns - START_NS) * 1e-9
        return rigid(turn_z(1.2), self._origin + [25.0, -30.0, 1.0] + CAR_VELOCITY * seconds)

    def parked(self) -> np.ndarray:
        return rigid(turn_z(-0.4), self._origin + [-20.0, 12.0, 1.0])

    def world(self, index: int) -> np.ndarray:
        """(units * 40, 3) hit points in the world: per unit 30 static points, then 10 on the car."""
        parts = []
        for unit in range(len(self.mounts)):
            moved = [
                self.car_at(self.timestamps[index] + 1000 * int(offset)) @ np.append(local, 1)
                for local, offset in zip(self._on_car[unit], self._offset_us[unit, NUM_STATIC:])
            ]
            parts += [self._static[unit], np.array(moved)[:, :3]]
        return np.concatenate(parts)

    def is_on_car(self) -> np.ndarray:
        return np.tile(np.arange(NUM_STATIC + NUM_ON_CAR) >= NUM_STATIC, len(self.mounts))

    def units(self, index: int) -> list[UnitReturns]:
        world = self.world(index).reshape(len(self.mounts), -1, 3)
        result = []
        for unit, (name, mount) in enumerate(self.mounts.items()):
            count = world.shape[1]
            local = [
                np.linalg.inv(self.pose_at(self.timestamps[index] + 1000 * int(offset)) @ mount) @ np.append(point, 1)
                for point, offset in zip(world[unit], self._offset_us[unit])
            ]
            result.append(
                UnitReturns(
                    name=name,
                    T_ego_sensor=mount,
                    points=np.array(local)[:, :3].astype(np.float32),
                    ring=np.arange(count, dtype=np.int32) % 32,
                    column=np.arange(count, dtype=np.int32),
                    offset_ns=self._offset_us[unit] * 1000,
                    intensity=np.arange(count).astype(np.uint8),
                    elevations=np.linspace(-0.5, 0.2, 32),
                    num_columns=count,
                )
            )
        return result

    def boxes(self, index: int) -> Boxes:
        world = np.stack([self.car_at(self.timestamps[index]), self.parked()])
        return Boxes(
            track_id=TRACKS,
            category=[CATEGORY_INDEX[name] for name in ("REGULAR_VEHICLE", "TRUCK_CAB")],
            size=np.tile(CAR_SIZE, (2, 1)),
            pose=np.linalg.inv(self.poses[index]) @ world,
            num_points=np.array([NUM_ON_CAR * len(self.mounts), 0]),
        )

    def sweep(self, index: int) -> Sweep:
        parts = [u.points @ u.T_ego_sensor[:3, :3].T + u.T_ego_sensor[:3, 3] for u in self.units(index)]
        return Sweep(np.concatenate(parts).astype(np.float32), None, self.poses[index], self.timestamps[index])

    def labels(self, index: int) -> None:
        return None
