"""Residual flow of sequences of sweeps, in the axes of the points at t.

BucketedSceneFlowEval and SceneFlowZoo pass such sequences and expect the flow in these axes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor, nn

from cflow_torch.config import Config
from cflow_torch.diagnosis.inspection import Inspection
from cflow_torch.errors import warn
from cflow_torch.estimate import make_model
from cflow_torch.ground.segmentation import find_ground, has_ground
from cflow_torch.tensors import read_positions
from cflow_torch.types import Array, Sweep, Window
from cflow_torch.windows.ego_motion import compensate


@dataclass(frozen=True)
class SequenceSweep:
    """One sweep of a sequence."""

    points: Array  # (N, 3) float, metres, in the frame of the sensor
    is_active: Array  # (N,) bool, False = ground, or outside the range of the data set
    sensor_to_ego: np.ndarray  # (4, 4) float64, `T_ego_sensor` of this sweep
    # (4, 4) float64, `T_global_ego`; "global" is any frame that all sweeps of a sequence share.
    ego_to_global: np.ndarray
    timestamp_ns: int | None = None  # nanoseconds, None = unknown

    def ego_points(self) -> Array:
        """Return (N, 3) points in the ego frame of this sweep; float64, unless they are already stored in it."""
        if np.array_equal(self.sensor_to_ego, np.eye(4)):
            return self.points
        device = self.points.device if isinstance(self.points, Tensor) else torch.device("cpu")
        points = compensate(read_positions([Sweep(self.points)], device), self.sensor_to_ego).t()
        return points if isinstance(self.points, Tensor) else points.numpy()


class SequenceFlow(nn.Module):
    """Base class of models that estimate residual flow from frames. They have no parameters and no buffers.

    Args:
        preset: as for `make_config`.
        device: "auto" = that of the given tensors, else a GPU if there is one, else the CPU.
        ground: None = the masks of the frames exclude the ground (`with_ground=False`). Otherwise the `method` of
            `find_ground`, by which we find the ground of every sweep and exclude it, too.
        **settings: any setting of the method.
    """

    def __init__(
        self, preset: str | Config = "default", device: Any = "auto", ground: str | None = None, **settings: Any
    ) -> None:
        super().__init__()
        self.model = make_model(preset, device, **settings)
        self.num_history: int = self.model.config.num_history
        self.ground = ground
        self._has_checked_ground = False
        self._inspect = Inspection()

    @torch.no_grad()
    def flows(self, sequences: Sequence[Sequence[SequenceSweep]], firsts: Sequence[int]) -> list[list[Tensor]]:
        """Estimate the residual flow of the pairs (i, i + 1) of several sequences.

        Args:
            sequences: B sequences of at least two frames each, in order of time.
            firsts: for each sequence, the first i whose flow is returned. The frames before it are only history.

        Returns:
            For each sequence of K frames, and each i from its first to K - 2: (N, 3) float32, metres until frame i + 1,
            ego motion removed, in the axes of the points of frame i. Inactive rows are 0.

        Convention:
            The history of frame i is frames i - 1, i - 2, ..., at most `num_history`. Its future (preset "offline") is
            frames i + 2, i + 3, ... Both may be shorter, so that every pair has a flow. We estimate the first
            windows of all sequences together, then the second ones, ...
        """
        windows = [self._windows(frames, first) for frames, first in zip(sequences, firsts)]
        flows: list[list[Tensor]] = [[] for _ in sequences]
        for step in range(max(map(len, windows), default=0)):
            members = [index for index, own in enumerate(windows) if step < len(own)]
            of_step = [windows[index][step] for index in members]
            results = self.model(of_step)
            self._inspect(of_step)
            for index, result in zip(members, results):
                now, following = sequences[index][firsts[index] + step :][:2]
                flows[index].append(in_axes_of_points(result.residual_flow, now, following))
        return flows

    def _windows(self, frames: Sequence[SequenceSweep], first: int) -> list[Window]:
        sweeps = self._sweeps(frames)
        num_future = self.model.config.num_future
        windows = []
        for i in range(first, len(sweeps) - 1):
            older = sweeps[max(i - self.num_history, 0) : i][::-1]
            later = sweeps[i + 2 : i + 2 + num_future]
            windows.append(Window(sweeps[i], sweeps[i + 1], tuple(older), tuple(later)))
        return windows

    def _sweeps(self, frames: Sequence[SequenceSweep]) -> list[Sweep]:
        points = [frame.ego_points() for frame in frames]
        ignored = [~frame.is_active for frame in frames]
        if self.ground is not None:
            ignored = [mask | find_ground(cloud, self.ground) for mask, cloud in zip(ignored, points)]
        elif not self._has_checked_ground:
            self._has_checked_ground = True
            if has_ground(points[-2][frames[-2].is_active]):
                warn(
                    "the active points contain ground, which connects the objects on it, so that moving ones are "
                    "missed. Load the data set with with_ground=False, or pass ground='auto'"
                )
        return [
            Sweep(cloud, mask, frame.ego_to_global, frame.timestamp_ns)
            for cloud, mask, frame in zip(points, ignored, frames)
        ]


def in_axes_of_points(residual_flow: Tensor, now: SequenceSweep, following: SequenceSweep) -> Tensor:
    """Rotate (N, 3) residual flow from the ego axes at t+1 (`following`) to the axes of the points at t (`now`).

    The rotation is (R_global_ego0 R_ego_sensor)^T R_global_ego1, in float64; flow is a difference of positions,
    so there is no translation.
    """
    rotation = np.eye(4)
    R_global_sensor = now.ego_to_global[:3, :3] @ now.sensor_to_ego[:3, :3]
    rotation[:3, :3] = R_global_sensor.T @ following.ego_to_global[:3, :3]
    return compensate(residual_flow.double().t(), rotation).t().float().contiguous()


def times_in_ns(stamps: Sequence[Any]) -> tuple[int | None, ...]:
    """Return time stamps in nanoseconds; None for all if they have another unit (some data sets number the sweeps)."""
    shortest = min((int(b) - int(a) for a, b in zip(stamps, stamps[1:])), default=0)
    return tuple(int(stamp) if shortest >= 1_000_000 else None for stamp in stamps)
