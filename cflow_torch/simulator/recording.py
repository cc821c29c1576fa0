"""What a simulated drive has for writers, besides sweeps, labels and boxes: the returns of each LiDAR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class UnitReturns:
    """The N returns of one LiDAR of the vehicle in one sweep, shot by shot.

    Args:
        name: the unit's name in the data set, for example "LIDAR_TOP".
        T_ego_sensor: (4, 4) float64, from the unit's frame to the ego frame.
        points: (N, 3) float32, metres, frame of the UNIT; motion-compensated if the data set's points are.
        ring: (N,) int32, row of `elevations`.
        column: (N,) int32, index of the azimuth step, counted in the direction of rotation.
        offset_ns: (N,) int64, time from the sweep's time stamp to the shot; may be negative.
        intensity: (N,) uint8.
        elevations: (B,) float64, radians, elevation of each ring, lowest first.
        num_columns: width of the unit's range image, whose height is B.
    """

    name: str
    T_ego_sensor: np.ndarray
    points: np.ndarray
    ring: np.ndarray
    column: np.ndarray
    offset_ns: np.ndarray
    intensity: np.ndarray
    elevations: np.ndarray
    num_columns: int
