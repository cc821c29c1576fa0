"""The spacing of points: how far around a position a sweep must have a point."""

from __future__ import annotations

import math

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.changed_pixels import directions
from oracle.height_slices import SLICE_HEIGHT
from oracle.pixels import bev_dims

AZIMUTHS, COLUMNS, PER_DEGREE = 8192, 1024, 16
NEAREST, FEWEST, SHARE, FARTHEST = 10.0, 100, 1.5, 6
UNIT = 4 / AZIMUTHS / 4  # radians, of an angle; a bin of azimuth is 4 to 8 of them wide


def spacing_of(cloud1: np.ndarray) -> tuple[float, float]:
    """The angle between neighbouring directions of the points (N, 3) of t+1, radians, and the rise between neighbouring
    rings, height over distance.

    They are the median of the gaps across in all rows of one degree, and up in all of 1024 columns.

    Convention: points nearer than 10 m to the origin of the ego frame do not count, nor do two rows or columns meet.
        Gaps are rounded down to a unit, and are less than 1024 units. The median is the first one that at least half of
        all do not exceed; 0 if there are fewer than 100.
    """
    far = cloud1[(cloud1[:, :2] ** 2).sum(1) >= NEAREST**2]
    (rows, azimuths), _ = directions(far, np.zeros(3), AZIMUTHS)
    across: list[float] = []
    for row in np.unique(rows):
        azimuth = np.unique(azimuths[rows == row])
        middle = (azimuth[:-1] % (AZIMUTHS // 4) + 0.5) / (AZIMUTHS // 4)
        across += np.floor(np.diff(azimuth) * (4 / (middle**2 + (1 - middle) ** 2))).tolist()
    (levels, columns), _ = directions(far, np.zeros(3), COLUMNS, PER_DEGREE)
    up: list[float] = []
    for column in np.unique(columns):
        up += np.diff(np.unique(levels[columns == column])).tolist()
    return median(across) * UNIT, median(up) / (57.3 * PER_DEGREE)


def median(gaps: list[float]) -> float:
    return min(sorted(gaps)[(len(gaps) - 1) // 2], 1023.0) if len(gaps) >= FEWEST else 0.0


def reach_of_pixels(angle: float, config: VerifiedConfig) -> np.ndarray:
    """(H, W): how many pixels around it the spacing covers: 1.5 times the angle times the distance of its middle from
    the origin, rounded, from 1 to 6."""
    reach = 1 + np.zeros(bev_dims(config, config.pixel_sizes[-1]), dtype=int)
    for pixels in range(2, FARTHEST + 1):
        reach += are_beyond((pixels - 0.5) / (SHARE * angle) if angle > 0 else math.inf, config)
    return reach


def are_tall(rise: float, config: VerifiedConfig) -> np.ndarray:
    """(H, W) bool: pixels so far away that rings are farther apart than a slice is high."""
    return are_beyond(SLICE_HEIGHT / config.pixel_sizes[-1] / rise if rise > 0 else math.inf, config)


def are_beyond(distance: float, config: VerifiedConfig) -> np.ndarray:
    """(H, W) bool: pixels whose middle is farther from the origin than this, in pixels."""
    size, (x0, y0) = config.pixel_sizes[-1], config.point_cloud_range[:2]
    height, width = bev_dims(config, size)
    y, x = np.arange(height) + (y0 / size + 0.5), np.arange(width) + (x0 / size + 0.5)
    return y[:, None] ** 2 + x**2 > distance**2
