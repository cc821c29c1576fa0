"""Sensor profiles of five data sets, and the weather.

"Chosen" marks the values that we chose, because no source gives them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cflow_torch.simulator.sensors import LidarProfile, SpinningLidar

# Elevations of beams, degrees above the sensor's xy plane. The 32-beam table agrees with a real Argoverse 2 sweep to
# 0.02 degrees. The other two are published tables that we have not compared with real sweeps.
# The 32-beam unit, by laser number. An Argoverse 2 vehicle has two.
_VLP_32C = (
    *(7.0, -1.667, 1.667, -0.667, 15.0, -0.333, 3.333, 0.667, 1.333, 0.0, 1.0, 2.333, 0.333, -1.0, 4.667, 10.333),
    *(-6.148, -15.639, -3.0, -2.0, -4.0, -8.843, -4.667, -3.333, -2.667, -5.333, -1.333, -7.254, -3.667, -11.31),
    *(-2.333, -25.0),
)
# Waymo's roof LiDAR, by row of the range image, highest first.
_WAYMO_TOP = (
    *(2.503, 2.321, 2.160, 1.989, 1.821, 1.650, 1.494, 1.322, 1.163, 0.991, 0.810, 0.648, 0.483, 0.320, 0.165, -0.012),
    *(-0.189, -0.342, -0.505, -0.683, -0.845, -1.020, -1.189, -1.367, -1.541, -1.757, -1.965, -2.189, -2.437, -2.668),
    *(-2.926, -3.209, -3.465, -3.771, -4.068, -4.366, -4.681, -5.024, -5.361, -5.716, -6.091, -6.457, -6.845, -7.248),
    *(-7.646, -8.082, -8.523, -8.957, -9.422, -9.885, -10.369, -10.830, -11.332, -11.823, -12.364, -12.909, -13.438),
    *(-13.984, -14.538, -15.076, -15.689, -16.300, -16.912, -17.547),
)
# The 64-beam unit of TruckScenes, by channel, highest first.
_PANDAR_64 = (
    *(14.87, 11.02, 8.047, 5.045, 3.028, 2.016, 1.848, 1.676, 1.51, 1.339, 1.172, 1.001, 0.834, 0.663, 0.496, 0.325),
    *(0.157, -0.012, -0.181, -0.349, -0.52, -0.687, -0.857, -1.025, -1.196, -1.363, -1.534, -1.7, -1.872, -2.04),
    *(-2.21, -2.377, -2.548, -2.712, -2.885, -3.052, -3.222, -3.387, -3.56, -3.724, -3.896, -4.062, -4.233, -4.397),
    *(-4.57, -4.732, -4.904, -5.069, -5.241, -5.403, -5.577, -5.738, -5.91, -6.073, -7.075, -8.071, -9.072, -9.897),
    *(-11.044, -12.018, -12.986, -13.942, -18.901, -24.909),
)


def _uniform(lowest: float, highest: float, number: int) -> tuple[float, ...]:
    return tuple(float(e) for e in np.linspace(lowest, highest, number))


_UP = SpinningLidar("up_lidar", _VLP_32C, 1800, (1.350, 0.0, 1.640), yaw=-0.58)
# Seen from above, it spins clockwise like the upper LiDAR, half a revolution apart.
_DOWN = SpinningLidar(
    *("down_lidar", _VLP_32C, 1800, (1.347, 0.005, 1.525)), yaw=-11.56, upside_down=True, start=0.0, span=360.0
)
_AV2 = LidarProfile((_UP, _DOWN))

# A quarter of the rays of av2. It is for examples and tests.
_DEMO = LidarProfile(
    (SpinningLidar("up_lidar", _uniform(-25, 7, 32), 900, (1.35, 0.0, 1.64)),),
    max_range=120.0,
)

# Chosen: the reach, and that a sweep begins behind the car.
_NUSCENES = LidarProfile(
    (SpinningLidar("LIDAR_TOP", _uniform(-30.67, 10.67, 32), 1084, (0.943713, 0.0, 1.84023), yaw=-90.0, start=-90.0),),
    max_range=100.0,
    reach=350.0,
    sweep_interval_ns=50_000_000,
    is_rolling=True,
    reference=1.0,
    ego_height=0.0,
)


def _truckscenes() -> LidarProfile:
    """Chosen: all mountings except LIDAR_TOP_FRONT's, active columns, reaches, and the time stamp at the sweep's start.

    We ignore the azimuth offsets between the beams of the 64-beam units.
    """

    def corner(name: str, side: int) -> SpinningLidar:
        mounting = ((4.9, side * 1.5, 2.2), side * 45.0)
        return SpinningLidar(name, _PANDAR_64, 1800, *mounting, active_columns=(225, 1575), reach=500.0)

    def wide(name: str, position: tuple[float, float, float], yaw: float, pitch: float) -> SpinningLidar:
        return SpinningLidar(
            *(name, _uniform(-45, 45, 32), 1024, position, yaw),
            pitch=pitch,
            active_columns=(256, 768),
            max_range=60.0,
            reach=110.0,
        )

    units = (
        corner("LIDAR_LEFT", 1),
        corner("LIDAR_RIGHT", -1),
        wide("LIDAR_TOP_FRONT", (5.008, -0.014, 3.234), 0.0, 56.0),
        wide("LIDAR_TOP_LEFT", (4.3, 1.3, 3.2), 90.0, 50.0),
        wide("LIDAR_TOP_RIGHT", (4.3, -1.3, 3.2), -90.0, 50.0),
        wide("LIDAR_REAR", (-1.1, 0.0, 0.95), 180.0, 0.0),
    )
    return LidarProfile(units, is_rolling=True, is_deskewed=False, ego_height=0.0, has_trailer=True)


def _waymo() -> LidarProfile:
    """One LiDAR on the roof, and four small ones for short ranges. Azimuths are on the grid of the range images.

    Chosen: the small LiDARs cover 90 degrees and lose 70 % of their returns. A few per cent of an image are valid.
    """
    rows = _uniform(-89.7, 29.7, 200)  # middles of 200 rows from -90 to 30 degrees

    def small(name: str, position: tuple[float, float, float], yaw: float) -> SpinningLidar:
        ahead = round(300 - yaw / 0.6)  # column 0 is behind the vehicle
        return SpinningLidar(
            *(name, rows, 600, position, yaw),
            start=180.0 - yaw,
            active_columns=(ahead - 75, ahead + 75),
            has_jitter=False,
            is_virtual=True,
            max_range=20.0,
            reach=150.0,
            dropout=0.7,
        )

    units = (
        SpinningLidar("TOP", _WAYMO_TOP, 2650, (1.43, 0.0, 2.184), yaw=148.0, start=32.0, has_jitter=False),
        small("FRONT", (4.07, 0.0, 0.69), 0.0),
        small("SIDE_LEFT", (3.25, 1.02, 0.98), 90.0),
        small("SIDE_RIGHT", (3.25, -1.02, 0.98), -90.0),
        small("REAR", (-1.15, 0.0, 0.46), 180.0),
    )
    return LidarProfile(units, min_range=0.4, max_range=75.0, is_rolling=True, reference=0.5, ego_height=0.0)


def _aevascenes() -> LidarProfile:
    """Chosen: the numbers of lines and columns, one pass from left to right per sweep, and the reaches."""

    def fan(
        name: str,
        position: tuple[float, float, float],
        yaw: float,
        azimuth: tuple[float, float],
        elevation: tuple[float, float],
        max_range: float,
    ) -> SpinningLidar:
        width = azimuth[1] - azimuth[0]
        lines, columns, reach = (80, 700, 1500.0) if width < 60 else (100, 800, 600.0)
        return SpinningLidar(
            *(name, _uniform(*elevation, lines), columns, position, yaw),
            start=azimuth[1],
            span=-width,
            max_range=max_range,
            reach=reach,
        )

    units = (
        fan("front_wide_lidar", (1.481, 0.151, 1.961), 0.6, (-62.6, 61.2), (-13.2, 7.6), 193.0),
        fan("front_narrow_lidar", (1.484, -0.158, 2.007), 1.0, (-19.9, 20.0), (-8.1, 7.4), 396.0),
        fan("right_lidar", (0.654, -0.679, 1.956), -88.6, (-59.4, 59.2), (-10.7, 9.4), 107.0),
        fan("rear_wide_lidar", (-0.819, 0.066, 2.006), -179.2, (-60.4, 66.5), (-10.4, 9.2), 198.0),
        fan("rear_narrow_lidar", (-0.918, -0.297, 1.971), -179.5, (-19.6, 19.1), (-5.7, 9.8), 512.0),
        fan("left_lidar", (0.697, 0.495, 1.935), 89.5, (-57.6, 59.5), (-11.2, 9.1), 107.0),
    )
    return LidarProfile(units, max_range=512.0, is_rolling=True)


PROFILES: dict[str, LidarProfile] = {
    "av2": _AV2,
    "av2_rolling": replace(_AV2, is_rolling=True),
    "demo": _DEMO,
    "nuscenes": _NUSCENES,
    "truckscenes": _truckscenes(),
    "waymo": _waymo(),
    "aevascenes": _aevascenes(),
}

# Extinction coefficient, 1/m, and the share of returns that are lost at any range.
WEATHER: dict[str, tuple[float, float]] = {
    "clear": (0.0, 0.0),
    "rain": (0.004, 0.06),
    "snow": (0.008, 0.15),
    "fog": (0.02, 0.02),
}


def in_weather(profile: LidarProfile, extinction: float, lost: float) -> LidarProfile:
    """The profile in bad weather. It loses distant and dark surfaces first, and a share `lost` of all returns."""

    def dropout(clear: float) -> float:
        return 1 - (1 - clear) * (1 - lost)

    units = tuple(u if u.dropout is None else replace(u, dropout=dropout(u.dropout)) for u in profile.units)
    return replace(profile, units=units, extinction=extinction, dropout=dropout(profile.dropout))
