"""GPS/IMU measurements (OXTS) of KITTI as poses, and what its images show."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from cflow_torch.data.file_errors import file_errors
from cflow_torch.data.paths import read_start
from cflow_torch.data.trajectory import positions_of_degrees
from cflow_torch.transforms import as_matrix, rotations_of
from cflow_torch.types import CFlowError

NUM_USED = 6  # of the 30 numbers of a measurement: latitude, longitude, altitude, roll, pitch, yaw
IMAGE_SIZE = (1242, 375)  # pixels; the rectified images of all days are within 18 pixels of it


def png_size(file: Path) -> tuple[int, int]:
    """Return width and height of a PNG image, pixels."""
    with file_errors(file, "copy it again"):
        start = read_start(file, 24)
        if start[:8] != b"\x89PNG\r\n\x1a\n" or len(start) < 24:
            raise ValueError("it is not a PNG file")
        return int.from_bytes(start[16:20], "big"), int.from_bytes(start[20:24], "big")


def poses_from_oxts(table: np.ndarray, file: Any) -> np.ndarray:
    """Convert the first numbers of measurements, (K, 6) float64, to poses (K, 4, 4) `T_world_imu`.

    The world begins at the first one.

    Convention: world x is east, y north, z up, see `positions_of_degrees`.
        Roll, pitch and yaw are radians about x (ahead), y (left) and z (up); yaw 0 = east.

    Source: the description of the data set, Geiger et al., "Vision meets Robotics: The KITTI Dataset", 2013.
    """
    if not np.isfinite(table).all():
        raise CFlowError(f"{file}, or a later file, has numbers that are not finite; copy them again")
    east, north = positions_of_degrees(*table[:, :2].T)
    return as_matrix(rotations_of(table[:, 3:6].T), np.stack([east, north, table[:, 2] - table[0, 2]], axis=1))


def in_image(points: np.ndarray, projection: np.ndarray, size: tuple[int, int], regions: np.ndarray) -> np.ndarray:
    """Return which of the (N, 3) points are in the image of the left colour camera, and in no region, (N,) bool.

    Args:
        points: (N, 3), metres, frame of the LiDAR.
        projection: (3, 4) from the frame of the LiDAR to pixels, homogeneous.
        size: width and height of the image, pixels.
        regions: (K, 4) pixels: left, top, right, bottom.
    """
    u, v, depth = (points.astype(np.float64) @ projection[:, :3].T + projection[:, 3]).T
    with np.errstate(all="ignore"):
        u, v = u / depth, v / depth
    width, height = size
    inside = (depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    for left, top, right, bottom in regions:
        inside &= ~((u >= left) & (u <= right) & (v >= top) & (v <= bottom))
    return inside  # type: ignore[no-any-return]
