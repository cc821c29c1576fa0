"""Changed pixels: what is not found in place in another sweep, although that sweep saw the place."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from oracle.height_slices import NUM_SLICES, SLICE_HEIGHT, SlicedSweeps

AZIMUTHS, ELEVATIONS, RISE = 720, 120, 1 / 57.3
ABOVE_LOWEST, NEAR = 1.6, 12.0  # metres


def find_changed(
    sweeps: SlicedSweeps, in_sight: Sequence[np.ndarray], origins: Sequence[Sequence[float]]
) -> np.ndarray:
    """(3, P) bool: pixels of which a slice is missing in another sweep and not hidden there; those of which one is
    missing in another sweep that saw its place; the first ones, and those of which every other sweep lacks a slice.
    None in windows of two sweeps.

    Args:
        in_sight: (N, 3) of each sweep: its points, those that are not drawn included.
        origins: of the ego frame of each sweep, metres, frame of t+1.

    Convention: the middle of a slice is that of the first one at or above the lowest point of its pixel.
    """
    is_missing, has_changed, may_be_fast = change = np.zeros((3, len(sweeps.pixels)), dtype=bool)
    num_lacking = np.zeros(len(sweeps.pixels), dtype=int)
    lowest = np.full(len(sweeps.pixels), np.inf)
    np.minimum.at(lowest, sweeps.pixel_of_point, sweeps.points[:, 2])
    _, row, col = sweeps.pixels.T
    for other in range(len(in_sight) * sweeps.has_history):
        sensor = np.array(origins[other]) + (0, 0, sensor_height(in_sight[0]))
        farthest = np.full((ELEVATIONS, AZIMUTHS), -np.inf)
        np.maximum.at(farthest, *directions(in_sight[other], sensor))
        missing = sweeps.slices & ~sweeps.around[other, row, col]
        num_lacking += missing > 0
        pixel, number = np.nonzero(missing[:, None] >> np.arange(NUM_SLICES) & 1)
        first = np.floor(lowest[pixel] / SLICE_HEIGHT)
        height = (first + (number - first) % NUM_SLICES + 0.5) * SLICE_HEIGHT
        direction, distance = directions(np.column_stack((sweeps.middle(sweeps.pixels[pixel]), height)), sensor)
        is_seen, is_unknown = farthest[direction] >= distance, farthest[direction] == -np.inf
        is_missing[pixel[is_seen | is_unknown]] = True
        has_changed[pixel[is_seen]] = True
    may_be_fast |= is_missing | ((num_lacking == len(in_sight) - 1) & sweeps.has_history)
    return change


def directions(
    points: np.ndarray, sensor: np.ndarray, azimuths: int = AZIMUTHS, per_degree: int = 1
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Bin of the range image and distance over ground of points (N, 3), as a sensor sees them; in float32.

    Convention: azimuth is y / (|x| + |y|), elevation is height over distance.
    """
    x, y, z = (points - sensor).astype(np.float32).T
    distance = np.sqrt(x * x + y * y)
    around = y / np.maximum(np.abs(x) + np.abs(y), np.float32(1e-3))
    around = np.where(x >= 0, around + np.float32(1), np.float32(3) - around)  # 0 ... 4
    azimuth = np.minimum((around * np.float32(azimuths / 4)).astype(int), azimuths - 1)
    elevations = per_degree * ELEVATIONS
    rise = z / (np.maximum(distance, np.float32(0.1)) * np.float32(RISE / per_degree)) + np.float32(elevations // 2)
    return (np.clip(np.floor(rise), 0, elevations - 1).astype(int), azimuth), distance


def sensor_height(cloud1: np.ndarray) -> float:
    """How high the sensor is over the origin of t+1: 1.6 m over the height that one near point of fifty is below, which
    is rounded down to a 256th of a metre.

    Convention: points (N, 3) are near up to 12 m around the origin, that included; without any it is 0.
    """
    heights = np.sort(cloud1[(cloud1[:, :2] ** 2).sum(1) <= NEAR**2, 2])
    return float(np.floor(heights[len(heights) // 50] * 256) / 256) + ABOVE_LOWEST if len(heights) else 0.0
