"""Smooth tracks forward and backward: a constant-velocity Kalman filter, and a Rauch-Tung-Striebel pass."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import index_in_group

ACCELERATION = 3.0  # m/s², standard deviation of the process noise


class MotionState(NamedTuple):
    """Position and velocity of R sightings, and their covariance, equal along all three axes."""

    state: Tensor  # (R, 2, 3) float64: position, metres; velocity, m/s
    covariance: Tensor  # (R, 2, 2) float64

    @property
    def position(self) -> Tensor:
        """(R, 3) metres."""
        return self.state[:, 0]

    @property
    def velocity(self) -> Tensor:
        """(R, 3) m/s."""
        return self.state[:, 1]

    def at(self, rows: Tensor) -> MotionState:
        """Select rows."""
        return MotionState(self.state[rows], self.covariance[rows])

    def put(self, rows: Tensor, values: MotionState) -> None:
        """Overwrite rows in place."""
        self.state[rows] = values.state
        self.covariance[rows] = values.covariance

    def predict(self, seconds: Tensor) -> tuple[MotionState, Tensor]:
        """Predict the motion after (R,) seconds. Returns it and the (R, 2, 2) transitions."""
        transition = torch.eye(2, dtype=seconds.dtype, device=seconds.device).repeat(len(seconds), 1, 1)
        transition[:, 0, 1] = seconds
        push = ACCELERATION * torch.stack([seconds**2 / 2, seconds], 1)
        covariance = transition @ self.covariance @ transition.transpose(1, 2) + push[:, :, None] * push[:, None]
        return MotionState(transition @ self.state, covariance), transition

    def update(self, measured: Tensor, noise: Tensor) -> MotionState:
        """Correct the motion by measured position and velocity, (R, 2, 3), with standard deviations (R, 2)."""
        innovation = self.covariance + torch.diag_embed(noise**2)
        gain = torch.linalg.solve(innovation, self.covariance).transpose(1, 2)  # both are symmetric
        covariance = self.covariance - gain @ self.covariance
        state = self.state + gain @ (measured - self.state)
        return MotionState(state, (covariance + covariance.transpose(1, 2)) / 2)  # symmetric despite rounding


def smooth(track: Tensor, seconds: Tensor, measured: Tensor, noise: Tensor) -> MotionState:
    """Estimate the motion of each track from all its sightings.

    Args:
        track: (R,) int64, track of each sighting, in ascending order, and in the order of time within a track.
        seconds: (R,) float64, time of each sighting.
        measured: (R, 2, 3) float64, position (metres) and velocity (m/s).
        noise: (R, 2) float64, standard deviations of both.

    Cost: a pass forward and a pass backward over the sightings of the longest track, all tracks at the same time.
    """
    motion = MotionState(measured.clone(), torch.diag_embed(noise**2))
    predicted = MotionState(motion.state.clone(), motion.covariance.clone())
    transition = torch.zeros_like(motion.covariance)
    rank = index_in_group(track)
    order = torch.argsort(rank, stable=True)
    steps = order.split(torch.bincount(rank).tolist())
    for rows in steps[1:]:
        last = rows - 1
        ahead, moved = motion.at(last).predict(seconds[rows] - seconds[last])
        predicted.put(rows, ahead)
        transition[rows] = moved
        motion.put(rows, ahead.update(measured[rows], noise[rows]))
    for rows in steps[:0:-1]:
        last = rows - 1
        earlier, later, ahead = motion.at(last), motion.at(rows), predicted.at(rows)
        gain = torch.linalg.solve(ahead.covariance, transition[rows] @ earlier.covariance).transpose(1, 2)
        state = earlier.state + gain @ (later.state - ahead.state)
        covariance = earlier.covariance + gain @ (later.covariance - ahead.covariance) @ gain.transpose(1, 2)
        motion.put(last, MotionState(state, covariance))
    return motion
