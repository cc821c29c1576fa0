"""Oracle of points to pixels: range, projection to the bird's-eye view, binary images, search radius."""

from __future__ import annotations

import math
from typing import Sequence, Tuple

import numpy as np

from cflow_torch.config import Config

# Rows and columns that an image covers: (first row, first column, height, width).
Box = Tuple[int, int, int, int]


def in_range(points: np.ndarray, config: Config) -> np.ndarray:
    """(N,) bool: the points (N, 3) that lie in `point_cloud_range`, both ends included. NaN does not."""
    low, high = np.array(config.point_cloud_range[:3]), np.array(config.point_cloud_range[3:])
    return np.all((points >= low) & (points <= high), axis=1)


def project_bev(points: np.ndarray, config: Config, pixel_size: float) -> np.ndarray:
    """Project (N, 3) metres to (N, 2) int64 pixels (row, column), u = floor((p - p_minus) / s) of Eq. 3d_to_bev."""
    x0, y0 = config.point_cloud_range[:2]
    column = np.floor((points[:, 0] - x0) / pixel_size)
    row = np.floor((points[:, 1] - y0) / pixel_size)
    return np.stack([row, column], axis=1).astype(np.int64)


def bev_dims(config: Config, pixel_size: float) -> tuple[int, int]:
    """(H, W) of the BEV image, with the + 1 (Eq. bev_dims)."""
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    return math.floor((y1 - y0) / pixel_size) + 1, math.floor((x1 - x0) / pixel_size) + 1


def bounding_box(pixels: Sequence[np.ndarray]) -> Box:
    """The smallest box that holds all pixels of the given (N, 2) lists, at least one pixel."""
    every = np.concatenate(list(pixels))
    (row, column), (last_row, last_column) = every.min(axis=0), every.max(axis=0)
    return int(row), int(column), int(last_row - row + 1), int(last_column - column + 1)


def occupancy(pixels: np.ndarray, box: Box) -> np.ndarray:
    """Binary image of the box: True where at least one of the pixels (N, 2) lies (text below Eq. bev_dims)."""
    row, column, height, width = box
    image = np.zeros((height, width), dtype=bool)
    for r, c in pixels.tolist():
        image[r - row, c - column] = True
    return image


def search_radius(config: Config, seconds: float, pixel_size: float) -> float | None:
    """Longest displacement in pixels: max_speed * time / s + one pixel; None = the paper's, half of the box."""
    if config.max_speed is None:
        return None
    return config.max_speed * abs(seconds) / pixel_size + 1
