"""Sensor profiles: which beams a vehicle's LiDARs have, where they sit and how well they measure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Dict, Tuple

import numpy as np

from cflow_torch.types import CFlowError

# Elevation of every laser of the 32-beam unit that Argoverse 2 carries twice, degrees, by laser number.
_VLP32C = (
    *(7.0, -1.667, 1.667, -0.667, 15.0, -0.333, 3.333, 0.667, 1.333, 0.0, 1.0, 2.333, 0.333, -1.0, 4.667, 10.333),
    *(-6.148, -15.639, -3.0, -2.0, -4.0, -8.843, -4.667, -3.333, -2.667, -5.333, -1.333, -7.254, -3.667, -11.31),
    *(-2.333, -25.0),
)


@dataclass(frozen=True)
class SpinningLidar:
    """One rotating multi-beam unit.

    Args:
        name: sensor name, as a log's calibration table has it.
        elevations: (B,) degrees above the sensor's xy plane, by laser number.
        num_columns: firings per turn, evenly spaced in azimuth.
        position: (3,) metres in the ego frame.
        yaw: degrees about z of the ego frame.
        upside_down: turned by 180 degrees about its x axis before the yaw.
    """

    name: str
    elevations: Tuple[float, ...]
    num_columns: int
    position: Tuple[float, float, float]
    yaw: float = 0.0
    upside_down: bool = False

    @property
    def T_ego_sensor(self) -> np.ndarray:
        """(4, 4) float64, sensor coordinates to ego."""
        cos, sin = math.cos(math.radians(self.yaw)), math.sin(math.radians(self.yaw))
        flip = -1.0 if self.upside_down else 1.0
        x, y, z = self.position
        return np.array([[cos, -sin * flip, 0, x], [sin, cos * flip, 0, y], [0, 0, flip, z], [0, 0, 0, 1]], np.float64)


@dataclass(frozen=True)
class LidarProfile:
    """All LiDARs of a vehicle and their common quality.

    Args:
        units: the sensors; laser numbers run on from unit to unit.
        min_range, max_range: metres; returns outside are lost.
        range_noise: standard deviation along the ray, metres.
        dropout: probability that a return is lost, whatever it hit.
        reach: metres at which a white surface that faces the sensor is still seen half of the time.
    """

    units: Tuple[SpinningLidar, ...]
    min_range: float = 1.0
    max_range: float = 200.0
    range_noise: float = 0.015
    dropout: float = 0.03
    reach: float = 600.0


PROFILES: Dict[str, LidarProfile] = {
    "av2": LidarProfile(
        (
            SpinningLidar("up_lidar", _VLP32C, 1800, (1.350, 0.0, 1.640), yaw=-0.58),
            SpinningLidar("down_lidar", _VLP32C, 1800, (1.347, 0.005, 1.525), yaw=-11.56, upside_down=True),
        )
    ),
    # A quarter of the rays, for examples and tests.
    "demo": LidarProfile(
        (SpinningLidar("up_lidar", tuple(float(e) for e in np.linspace(-25, 7, 32)), 900, (1.35, 0.0, 1.64)),),
        max_range=120.0,
    ),
}


def get_profile(name: str) -> LidarProfile:
    """The profile called `name`.

    Raises:
        CFlowError: there is none of that name.
    """
    if name not in PROFILES:
        raise CFlowError(f"sensor profile {name!r} does not exist; choose one of {', '.join(sorted(PROFILES))}")
    return PROFILES[name]
