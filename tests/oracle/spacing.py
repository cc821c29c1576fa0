"""The spacing of points: how far around a position a sweep must have a point."""

from __future__ import annotations

import math

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.changed_pixels import directions
from oracle.pixels import bev_dims

AZIMUTHS, NEAREST, FEWEST, SHARE, FARTHEST = 8192, 10.0, 100, 1.5, 6
UNIT = 4 / AZIMUTHS / 4  # radians, of an angle; a bin of azimuth is 4 to 8 of them wide


def angle_between_points(cloud1: np.ndarray) -> float:
    """Radians between neighbouring directions of the points (N, 3) of t+1, the median of all rows of one degree.

    Convention: points nearer than 10 m to the origin of the ego frame do not count, nor do two rows meet. Angles are
        rounded down to a unit, and are less than 1024 units. The median is the first angle that at least half of all
        do not exceed; 0 if there are fewer than 100.
    """
    far = cloud1[(cloud1[:, :2] ** 2).sum(1) >= NEAREST**2]
    (rows, azimuths), _ = directions(far, np.zeros(3), AZIMUTHS)
    found = []
    for row in np.unique(rows):
        azimuth = np.unique(azimuths[rows == row])
        middle = (azimuth[:-1] % (AZIMUTHS // 4) + 0.5) / (AZIMUTHS // 4)
        units = np.floor(np.diff(azimuth) * (4 / (middle**2 + (1 - middle) ** 2)))
        found.extend(np.minimum(units, 1023).tolist())
    return float(sorted(found)[(len(found) - 1) // 2] * UNIT) if len(found) >= FEWEST else 0.0


def reach_of_pixels(angle: float, config: VerifiedConfig) -> np.ndarray:
    """(H, W): how many pixels around it the spacing covers: 1.5 times the angle times the distance of its middle from
    the origin, rounded, from 1 to 6."""
    size, (x0, y0) = config.pixel_sizes[-1], config.point_cloud_range[:2]
    height, width = bev_dims(config, size)
    y, x = np.arange(height) + (y0 / size + 0.5), np.arange(width) + (x0 / size + 0.5)
    reach = np.ones((height, width), dtype=int)
    for pixels in range(2, FARTHEST + 1):
        least = (pixels - 0.5) / (SHARE * angle) if angle > 0 else math.inf
        reach += np.abs(x).astype(np.float32) > np.sqrt(np.maximum(least**2 - y[:, None] ** 2, 0)).astype(np.float32)
    return reach
