"""A constant-velocity Kalman filter of many objects at once.

The noise is equal along all axes, so one 2x2 covariance of (position, velocity) serves all three.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class States:
    """States of K objects.

    Args:
        position, velocity: (K, 3) float64, metres and m/s in the world.
        covariance: (K, 2, 2) float64 of (position, velocity), for each axis.
    """

    position: Tensor
    velocity: Tensor
    covariance: Tensor

    def predict(self, seconds: float, acceleration: float) -> States:
        """States after `seconds`, in which each object has a constant random acceleration of the given standard
        deviation, m/s²."""
        transition = self.covariance.new_tensor([[1.0, seconds], [0.0, 1.0]])
        push = self.covariance.new_tensor([seconds**2 / 2, seconds]) * acceleration
        covariance = transition @ self.covariance @ transition.T + torch.outer(push, push)
        return States(self.position + seconds * self.velocity, self.velocity, covariance)

    def update(self, position: Tensor, velocity: Tensor, noise: Tensor) -> States:
        """States after a measurement of position and velocity.

        Args:
            position, velocity: (K, 3) float64, measured.
            noise: (K, 2) float64, standard deviations of the two, per axis.
        """
        residual = torch.stack([position - self.position, velocity - self.velocity], 1)  # (K, 2, 3)
        spread = self.covariance + torch.diag_embed(noise**2)
        gain = torch.linalg.solve(spread, self.covariance).transpose(1, 2)  # both are symmetric
        change = gain @ residual
        covariance = (torch.eye(2, dtype=gain.dtype, device=gain.device) - gain) @ self.covariance
        covariance = (covariance + covariance.transpose(1, 2)) / 2  # symmetric despite rounding
        return States(self.position + change[:, 0], self.velocity + change[:, 1], covariance)
