"""Sensor profiles: the beams of a LiDAR, its mounting, its firing times, and the quality of its measurements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SpinningLidar:
    """One unit that sweeps a column of beams about its z axis, over a full revolution or over a fan.

    Args:
        name: sensor name, as in a log's calibration table.
        elevations: (B,) degrees above the sensor's xy plane, by laser number.
        num_columns: firings per sweep, evenly spaced in azimuth and time.
        position: (3,) metres in the ego frame.
        yaw: degrees about z of the ego frame.
        upside_down: rotated by 180 degrees about its x axis before pitch and yaw.
        pitch: degrees about y before the yaw, positive = downwards.
        start: azimuth in the sensor frame at which a sweep begins, degrees: the outer edge of the first column.
        span: degrees of azimuth per sweep, positive = counter-clockwise about the sensor's z axis.
        active_columns: first column that fires, and the one after the last; None = all. The range image has all
            columns. A negative column, which fires before column 0, is at the end of the image.
        has_jitter: shift all azimuths of a sweep at random within a column; False = shoot at the column's middle.
        is_virtual: take all shots from the ego pose at the time stamp, like the images of Waymo's small LiDARs.
        max_range, reach, dropout: as in `LidarProfile`, whose values apply where these are None.
    """

    name: str
    elevations: tuple[float, ...]
    num_columns: int
    position: tuple[float, float, float]
    yaw: float = 0.0
    upside_down: bool = False
    pitch: float = 0.0
    start: float = 180.0
    span: float = -360.0
    active_columns: tuple[int, int] | None = None
    has_jitter: bool = True
    is_virtual: bool = False
    max_range: float | None = None
    reach: float | None = None
    dropout: float | None = None

    @property
    def T_ego_sensor(self) -> np.ndarray:
        """(4, 4) float64, from the sensor frame to the ego frame."""
        cos, sin = math.cos(math.radians(self.yaw)), math.sin(math.radians(self.yaw))
        level = math.cos(math.radians(self.pitch))
        down = math.sin(math.radians(self.pitch))
        flip = -1.0 if self.upside_down else 1.0
        ahead = (cos * level, sin * level, -down, 0)
        left = (-sin * flip, cos * flip, 0, 0)
        up = (cos * down * flip, sin * down * flip, level * flip, 0)
        return np.array([ahead, left, up, (*self.position, 1)], np.float64).T


@dataclass(frozen=True)
class LidarProfile:
    """All LiDARs of a vehicle, and what they have in common.

    Args:
        units: the LiDARs; laser numbers count through all of them.
        min_range, max_range: metres; returns outside are lost.
        range_noise: standard deviation along the ray, metres.
        dropout: probability that a return is lost, whatever it hit.
        reach: metres at which a white surface that faces the sensor is detected half of the time.
        sweep_interval_ns: time from sweep to sweep, and duration of a sweep.
        is_rolling: every shot has its own time, and the scene moves during the sweep. False = all shots are taken at
            the time stamp.
        reference: position of the time stamp within the sweep: 0 = first column, 1 = one column after the last.
        is_deskewed: the ego motion between each shot and the time stamp is compensated. Only for rolling profiles.
        ego_height: height of the ego frame's origin above the ground, metres.
        has_trailer: the vehicle is an articulated truck; returns from the truck itself are lost.
        extinction: extinction coefficient of the air, 1/m.
    """

    units: tuple[SpinningLidar, ...]
    min_range: float = 1.0
    max_range: float = 200.0
    range_noise: float = 0.015
    dropout: float = 0.03
    reach: float = 600.0
    sweep_interval_ns: int = 100_000_000
    is_rolling: bool = False
    reference: float = 0.0
    is_deskewed: bool = True
    ego_height: float = 0.35
    has_trailer: bool = False
    extinction: float = 0.0
