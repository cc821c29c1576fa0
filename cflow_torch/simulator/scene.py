"""A scene: the ground, the route of the recording vehicle, bodies, and the poses of all solids at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Sequence

import numpy as np
import torch

from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import HIP, Body, Route
from cflow_torch.simulator.raycast import Solids


@dataclass(frozen=True)
class SolidTable:
    """The solids of all bodies, one row each; columns as in `objects.Solid`.

    Args:
        body: (P,) int64, index of the body that a solid belongs to.
    """

    body: np.ndarray
    kind: np.ndarray
    centre: np.ndarray
    half: np.ndarray
    pitch: np.ndarray
    roll: np.ndarray
    albedo: np.ndarray
    is_foliage: np.ndarray
    swing: np.ndarray
    stride: np.ndarray
    phase: np.ndarray

    @classmethod
    def of(cls, bodies: tuple[Body, ...]) -> SolidTable:
        """List the solids in the order of the bodies."""
        body = np.repeat(np.arange(len(bodies)), [len(b.solids) for b in bodies])
        return cls(body, *(np.array(column) for column in zip(*(solid for b in bodies for solid in b.solids))))


@dataclass(frozen=True)
class Scene:
    """A street with traffic.

    Args:
        ground: the ground.
        ego: route of the recording vehicle's rear axle.
        bodies: everything else.
        num_own: number of bodies, the last ones, that are the recording vehicle itself. They occlude other bodies, but
            have no returns.
    """

    ground: Ground
    ego: Route
    bodies: tuple[Body, ...]
    num_own: int = 0

    @cached_property
    def table(self) -> SolidTable:
        """The solids of the bodies."""
        return SolidTable.of(self.bodies)

    def with_own(self, own: Sequence[Body]) -> Scene:
        """The scene with the recording vehicle added."""
        return Scene(self.ground, self.ego, (*self.bodies, *own), len(own))

    def body_poses(self, seconds: np.ndarray) -> np.ndarray:
        """(T, num_bodies, 4, 4) float64 `T_world_body` at `seconds` (T,)."""
        paths = np.stack([body.trajectory(seconds) for body in self.bodies], 1)
        return self.ground.pose(paths[..., 0], paths[..., 1], paths[..., 2])

    def dynamic_part(self) -> tuple[Scene, np.ndarray]:
        """The scene reduced to its moving bodies, and (P',) int64 index in this scene of each of its solids."""
        is_dynamic = np.array([not body.is_static for body in self.bodies])
        chosen = tuple(body for body, moves in zip(self.bodies, is_dynamic) if moves)
        return Scene(self.ground, self.ego, chosen), np.flatnonzero(is_dynamic[self.table.body])

    def solids(self, seconds: float, body_poses: np.ndarray) -> Solids:
        """All solids at one time.

        Args:
            seconds: time, which moves the legs.
            body_poses: (num_bodies, 4, 4) float64 `T_world_body` at that time.
        """
        table = self.table
        # In the body: rotate about x, about y, move to the centre; a leg then swings about the y axis through the hip.
        angle = table.swing * np.sin(2 * math.pi * table.stride * seconds + table.phase)
        hip = np.where(angle[:, None] == 0, 0, (0, 0, HIP))
        pose = _rotation(1, table.pitch) @ _rotation(0, table.roll)
        pose[:, :3, 3] = table.centre - hip
        pose = _rotation(1, angle) @ pose
        pose[:, :3, 3] += hip
        return Solids(
            torch.from_numpy(table.kind),
            torch.from_numpy(body_poses[table.body] @ pose),
            torch.from_numpy(table.half),
            torch.from_numpy(table.albedo).float(),
            torch.from_numpy(table.is_foliage),
        )


def _rotation(axis: int, angle: np.ndarray) -> np.ndarray:
    """(P, 4, 4) rotations by `angle` (P,) radians about x (0), y (1) or z (2)."""
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.tile(np.eye(4), (len(angle), 1, 1))
    rotation[:, first, first] = rotation[:, second, second] = np.cos(angle)
    rotation[:, second, first] = np.sin(angle)
    rotation[:, first, second] = -rotation[:, second, first]
    return rotation
