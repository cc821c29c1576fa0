"""A scene: the ground, the route of the recording vehicle, bodies, and the poses of all solids at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from cflow_torch.simulator.ground import Ground
from cflow_torch.simulator.objects import HIP, Body, Solid
from cflow_torch.simulator.raycast import Solids
from cflow_torch.simulator.trajectories import Route
from cflow_torch.transforms import as_matrix, rotations_about


@dataclass(frozen=True)
class Scene:
    """The world of a drive.

    Args:
        ground: height of the ground.
        ego: route of the recording vehicle's rear axle.
        bodies: all objects and background.
        num_own: the last `num_own` bodies form the recording vehicle. They occlude other bodies, but return nothing.
    """

    ground: Ground
    ego: Route
    bodies: tuple[Body, ...]
    num_own: int = 0

    @cached_property
    def body_of_solid(self) -> np.ndarray:
        """(P,) int64 index of the body that each solid belongs to."""
        return np.repeat(np.arange(len(self.bodies)), [len(body.solids) for body in self.bodies])

    @cached_property
    def _columns(self) -> dict[str, np.ndarray]:
        """Fields of the P solids, in the order of the bodies."""
        rows = (solid for body in self.bodies for solid in body.solids)
        return dict(zip(Solid._fields, map(np.array, zip(*rows))))

    def body_poses(self, seconds: np.ndarray) -> np.ndarray:
        """(T, num_bodies, 4, 4) float64 `T_world_body` at `seconds` (T,)."""
        paths = np.stack([body.trajectory(seconds) for body in self.bodies], 1)
        return self.ground.pose(paths[..., 0], paths[..., 1], paths[..., 2])

    def dynamic_part(self) -> tuple[Scene, np.ndarray]:
        """A scene of the moving bodies only; (P',) int64 index in this scene of each solid of the new one."""
        is_dynamic = np.array([not body.is_static for body in self.bodies])
        chosen = tuple(body for body, moves in zip(self.bodies, is_dynamic) if moves)
        return Scene(self.ground, self.ego, chosen), np.flatnonzero(is_dynamic[self.body_of_solid])

    def solids(self, seconds: float, body_poses: np.ndarray) -> Solids:
        """All solids at one time.

        Args:
            seconds: the time, which determines the swing of legs.
            body_poses: (num_bodies, 4, 4) float64 `T_world_body` at that time.
        """
        of = self._columns
        # In the body frame: rotate about x, then y; move to the centre; swing about the y axis through the hip.
        angle = of["swing"] * np.sin(2 * math.pi * of["stride"] * seconds + of["phase"])
        hip = np.where(angle[:, None] == 0, 0, (0, 0, HIP))
        pose = as_matrix(rotations_about(1, of["pitch"])) @ as_matrix(rotations_about(0, of["roll"]))
        pose[:, :3, 3] = of["centre"] - hip
        pose = as_matrix(rotations_about(1, angle)) @ pose
        pose[:, :3, 3] += hip
        return Solids(
            torch.from_numpy(of["kind"]),
            torch.from_numpy(body_poses[self.body_of_solid] @ pose),
            torch.from_numpy(of["half"]),
            torch.from_numpy(of["albedo"]).float(),
            torch.from_numpy(of["is_foliage"]),
            torch.from_numpy(self.body_of_solid >= len(self.bodies) - self.num_own),
        )
