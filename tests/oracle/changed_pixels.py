"""Changed pixels: what is not found in place in another sweep, although that sweep saw the place."""

from __future__ import annotations

import math
from typing import NamedTuple, Sequence

import numpy as np

from oracle.height_slices import NUM_SLICES, SLICE_HEIGHT, Cell, Pixel, SlicedSweeps

AZIMUTHS, ELEVATIONS, RISE = 720, 120, 1 / 57.3
ABOVE_LOWEST, NEAR = 1.6, 12.0  # metres


class Change(NamedTuple):
    """Pixels of which a slice is missing in another sweep and not hidden there, and those of which one is missing in
    another sweep that saw its place."""

    is_missing: set[Pixel]
    has_changed: set[Pixel]


def find_changed(sweeps: SlicedSweeps, in_sight: Sequence[np.ndarray], origins: Sequence[Sequence[float]]) -> Change:
    """Compare every pixel in place with every other sweep; nothing has changed in windows of two sweeps.

    Args:
        sweeps: the window.
        in_sight: (N, 3) of each sweep: its points, those that are not drawn included.
        origins: of the ego frame of each sweep, metres, frame of t+1.
    """
    change = Change(set(), set())
    if len(sweeps.images) == 2:
        return change
    lowest: dict[Pixel, float] = {}
    for pixel, point in sweeps.points():
        lowest[pixel] = min(point.z, lowest.get(pixel, math.inf))
    height = sensor_height(in_sight[0])
    for other, (cloud, origin) in enumerate(zip(in_sight, origins)):
        sensor, farthest = np.array(origin) + (0, 0, height), {}  # type: ignore[var-annotated]
        for direction, distance in zip(*directions(cloud, sensor)):
            farthest[direction] = max(distance, farthest.get(direction, 0.0))
        pixels, middles = [], []
        for pixel in lowest:
            missing = sweeps.at(*pixel) & ~sweeps.around(other, *pixel[1:])
            for number in range(NUM_SLICES):
                if missing >> number & 1:
                    pixels.append(pixel)
                    middles.append(middle_of(sweeps, pixel, number, lowest[pixel]))
        for pixel, direction, distance in zip(pixels, *directions(np.array(middles).reshape(-1, 3), sensor)):
            if farthest.get(direction, math.inf) >= distance:
                change.is_missing.add(pixel)
                if direction in farthest:
                    change.has_changed.add(pixel)
    return change


def middle_of(sweeps: SlicedSweeps, pixel: Pixel, number: int, lowest: float) -> tuple[float, float, float]:
    """x, y, z of the middle of a slice, the first one at or above the lowest point of its pixel."""
    _, row, col = pixel
    first = math.floor(lowest / SLICE_HEIGHT)
    height = first + (number - first) % NUM_SLICES + 0.5
    x, y = (col + 0.5) * sweeps.size + sweeps.lower[0], (row + 0.5) * sweeps.size + sweeps.lower[1]
    return x, y, height * SLICE_HEIGHT


def directions(points: np.ndarray, sensor: np.ndarray) -> tuple[list[Cell], list[float]]:
    """Bin of the range image and distance over ground of points (N, 3), as a sensor sees them; in float32.

    Convention: azimuth is y / (|x| + |y|), elevation is height over distance.
    """
    x, y, z = (points - sensor).astype(np.float32).T
    distance = np.sqrt(x * x + y * y)
    around = y / np.maximum(np.abs(x) + np.abs(y), np.float32(1e-3))
    around = np.where(x >= 0, around + np.float32(1), np.float32(3) - around)  # 0 ... 4
    azimuth = np.minimum((around * np.float32(AZIMUTHS / 4)).astype(int), AZIMUTHS - 1)
    rise = z / (np.maximum(distance, np.float32(0.1)) * np.float32(RISE)) + np.float32(ELEVATIONS // 2)
    elevation = np.clip(np.floor(rise), 0, ELEVATIONS - 1).astype(int)
    return list(zip(elevation.tolist(), azimuth.tolist())), distance.tolist()


def sensor_height(cloud1: np.ndarray) -> float:
    """How high the sensor is over the origin of t+1: 1.6 m over the height that one near point of fifty is below, which
    is rounded down to a 256th of a metre.

    Convention: points (N, 3) are near up to 12 m around the origin, that included; without any it is 0.
    """
    heights = sorted(z for x, y, z in cloud1.tolist() if x * x + y * y <= NEAR**2)
    return math.floor(heights[len(heights) // 50] * 256) / 256 + ABOVE_LOWEST if heights else 0.0
