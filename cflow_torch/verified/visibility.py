"""Visibility: a place that a nearer return hides in a sweep may hold anything there, and says nothing.

Near objects cast shadows on what stands behind them. When the sensor moves, the shadows move as well: what stands there
vanishes and appears, as if it moved. A range image of each sweep, seen from the sensor, tells the hidden places.
"""

from __future__ import annotations

import math
from typing import Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero
from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_AZIMUTHS = 720  # bins of half a degree
_ELEVATIONS, _RISE = 120, 1 / 57.3  # bins, and what each of them rises by, metres a metre; half of them below level
_NEARER = 0.5  # metres by which a return must be nearer than a place that it hides
# Where the sensor stands is a guess: over the origin of the ego frame, so high above the lowest points within 12 m.
_ABOVE_LOWEST, _AROUND = 1.6, 12.0


class RangeImages:
    """The nearest return in each direction of every sweep, with the eight directions around it.

    Args:
        sweeps: points that take part, without ground.
    """

    def __init__(self, sweeps: HeightSlicedSweeps) -> None:
        batch = sweeps.batch
        self._num_steps, self._origin = batch.num_steps, batch.origin.clone()
        self._origin[:, :, 2] += self._sensor_height(sweeps)[:, None]
        seen = flat_nonzero(batch.takes_part)
        x, y, z = batch.positions.index_select(1, seen).unbind(0)
        place, distance = self._place(batch.image.index_select(0, seen).long(), x, y, z)
        num_images = batch.num_windows * batch.num_steps
        nearest = segment_amin(distance, place, num_images * _ELEVATIONS * _AZIMUTHS, math.inf)
        nearest = F.pad(nearest.view(num_images, 1, _ELEVATIONS, _AZIMUTHS), (1, 1, 0, 0), mode="circular")
        self._nearest = -F.max_pool2d(-nearest, 3, 1, (1, 0)).view(-1)

    def hide(self, window: Tensor, step: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """(K,) bool: which places does a sweep not see?

        Args:
            window, step: (K,) int64, the sweep.
            x, y, z: (K,) float64, metres, frame of t+1.
        """
        place, distance = self._place(window * self._num_steps + step, x, y, z)
        return self._nearest.index_select(0, place) < distance - _NEARER

    def _place(self, image: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tuple[Tensor, Tensor]:
        """Direction in the range images, and the distance over ground, metres."""
        x0, y0, z0 = self._origin.view(-1, 3).index_select(0, image).unbind(1)
        x, y, z = x - x0, y - y0, z - z0
        distance = torch.sqrt(x * x + y * y)
        azimuth = torch.floor((torch.atan2(y, x) / math.tau + 0.5) * _AZIMUTHS).long().remainder_(_AZIMUTHS)
        rise = torch.floor(z / distance.clamp(min=0.1) / _RISE).clamp_(-_ELEVATIONS // 2, _ELEVATIONS // 2 - 1)
        row = image * _ELEVATIONS + rise.nan_to_num_(0.0).long() + _ELEVATIONS // 2
        return row * _AZIMUTHS + azimuth, distance

    @staticmethod
    def _sensor_height(sweeps: HeightSlicedSweeps) -> Tensor:
        """(B,) float64, metres, above the origin of t+1: from the height that one near point of fifty is below."""
        batch = sweeps.batch
        x, y, z = batch.positions[:, : batch.num_newest].unbind(0)
        near = flat_nonzero((x * x + y * y <= _AROUND**2) & batch.takes_part[: batch.num_newest])
        window = divide(batch.image.index_select(0, near).long(), batch.num_steps)
        height, by_height = z.index_select(0, near).sort()
        window, by_window = window.index_select(0, by_height).sort(stable=True)
        count = torch.bincount(window, minlength=batch.num_windows)
        chosen = count.cumsum(0) - count + divide(count, 50)
        # Without near points it is 0.
        height = F.pad(height.index_select(0, by_window), (0, 1), value=-_ABOVE_LOWEST)
        return height.index_select(0, torch.where(count > 0, chosen, near.numel())) + _ABOVE_LOWEST
