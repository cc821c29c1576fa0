"""Visibility: the nearest return in each direction of a sweep, and which places it hides."""

from __future__ import annotations

import math
from typing import Dict, Sequence, Tuple

import numpy as np

AZIMUTHS, ELEVATIONS = 720, 120
RISE = 1 / 57.3  # metres a metre, of an elevation
NEARER = 0.5  # metres
ABOVE_LOWEST, AROUND = 1.6, 12.0  # metres

Place = Tuple[float, float, float]  # x, y, z, metres, frame of t+1


def sensor_height(cloud1: np.ndarray) -> float:
    """How high the sensor stands over the origin of t+1: 1.6 m over the height that one near point of fifty is below.

    Args:
        cloud1: (N, 3), points of t+1 that take part.

    Convention: points are near up to 12 m around the origin, that included; without any it is 0.
    """
    heights = sorted(z for x, y, z in cloud1.tolist() if x * x + y * y <= AROUND**2)
    return heights[len(heights) // 50] + ABOVE_LOWEST if heights else 0.0


class RangeImage:
    """One sweep as its sensor saw it.

    Args:
        cloud: (N, 3), metres, frame of t+1: its points that take part, those that stand out of the ground by little
            included.
        origin: of the ego frame of this sweep.
        height: of the sensor over it, metres.
    """

    def __init__(self, cloud: np.ndarray, origin: Sequence[float], height: float) -> None:
        self._sensor = (origin[0], origin[1], origin[2] + height)
        self._nearest: Dict[Tuple[int, int], float] = {}
        for place in cloud.tolist():
            direction, distance = self._direction(place)
            self._nearest[direction] = min(distance, self._nearest.get(direction, math.inf))

    def hides(self, place: Place) -> bool:
        """Is a return nearer by more than half a metre, in the direction of a place or in one of the eight around?

        Convention: azimuths go round, elevations do not.
        """
        (azimuth, elevation), distance = self._direction(place)
        around = [((azimuth + da) % AZIMUTHS, elevation + de) for da in (-1, 0, 1) for de in (-1, 0, 1)]
        return min(self._nearest.get(direction, math.inf) for direction in around) < distance - NEARER

    def _direction(self, place: Sequence[float]) -> Tuple[Tuple[int, int], float]:
        """Azimuth and elevation, and the distance over ground."""
        x, y, z = (at - own for at, own in zip(place, self._sensor))
        distance = math.sqrt(x * x + y * y)
        azimuth = math.floor((math.atan2(y, x) / math.tau + 0.5) * AZIMUTHS) % AZIMUTHS
        elevation = math.floor(z / max(distance, 0.1) / RISE)
        return (azimuth, min(max(elevation, -ELEVATIONS // 2), ELEVATIONS // 2 - 1)), distance
