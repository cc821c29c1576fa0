"""A constant-velocity Kalman filter of many objects at once.

Noise is the same along all axes, so a covariance is that of (position, velocity) of one axis, for each of the three.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class States:
    """K objects.

    Args:
        position, velocity: (K, 3) float64, metres and m/s in the world.
        covariance: (K, 2, 2) float64 of (position, velocity), the same for each axis.
    """

    position: Tensor
    velocity: Tensor
    covariance: Tensor

    def predict(self, seconds: float, acceleration: float) -> States:
        """The states so many seconds later; accelerations of standard deviation `acceleration`, m/s², are constant
        meanwhile."""
        over = self.covariance.new_tensor([[1.0, seconds], [0.0, 1.0]])
        push = self.covariance.new_tensor([seconds**2 / 2, seconds]) * acceleration
        covariance = over @ self.covariance @ over.T + torch.outer(push, push)
        return States(self.position + seconds * self.velocity, self.velocity, covariance)

    def update(self, position: Tensor, velocity: Tensor, noise: Tensor) -> States:
        """The states after a measurement of both.

        Args:
            position, velocity: (K, 3) float64, measured.
            noise: (K, 2) float64, standard deviations of the two, per axis.
        """
        off = torch.stack([position - self.position, velocity - self.velocity], 1)  # (K, 2, 3)
        spread = self.covariance + torch.diag_embed(noise**2)
        gain = torch.linalg.solve(spread, self.covariance).transpose(1, 2)  # both are symmetric
        change = gain @ off
        left = torch.eye(2, dtype=gain.dtype, device=gain.device) - gain
        covariance = left @ self.covariance
        return States(
            self.position + change[:, 0],
            self.velocity + change[:, 1],
            (covariance + covariance.transpose(1, 2)) / 2,
        )
