"""Low columns are ground: what a ground mask left over, found by its height above the ground around it."""

from __future__ import annotations

from typing import Dict, List, Sequence, Tuple

import numpy as np

from cflow_torch.config import Config
from oracle.pixels import in_range, project_bev


def ground_heights(ground: Sequence[np.ndarray], config: Config) -> Dict[Tuple[int, int], int]:
    """Mean height of the ground around each block of 2 m x 2 m.

    Args:
        ground: (N, 3) float64 ground points, metres, frame of t+1, of each sweep that has a ground mask.
        config: `point_cloud_range`; points outside of it count nowhere.

    Returns:
        Block (row, column) -> centimetres: heights of its points and of those of the eight blocks around it, each
        rounded down, then their mean, rounded down. Blocks with less than five such points are missing.
    """
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    heights: Dict[Tuple[int, int], List[int]] = {}
    for points in ground:
        for x, y, z in points[in_range(points, config)].tolist():
            heights.setdefault(_block(x, y, config), []).append(_centimetres(z))
    means = {}
    for row in range(int((y1 - y0) // 2.0) + 1):
        for column in range(int((x1 - x0) // 2.0) + 1):
            around = [
                height
                for near_row in range(row - 1, row + 2)
                for near_column in range(column - 1, column + 2)
                for height in heights.get((near_row, near_column), [])
            ]
            if len(around) >= 5:
                means[row, column] = sum(around) // len(around)
    return means


def in_low_column(
    points: np.ndarray, means: Dict[Tuple[int, int], int], clearance: float, pixel_size: float, config: Config
) -> np.ndarray:
    """Which points of a sweep stand on pixels that are ground.

    Args:
        points: (N, 3) float64, metres, frame of t+1, inside the region.
        means: as `ground_heights` gives them.
        clearance: metres.
        pixel_size: s, metres.
        config: `point_cloud_range`.

    Returns:
        (N,) bool: no point of the pixel, and none of a pixel at most two rows and two columns away, lies `clearance` or
        more above the ground of its own block. Where no ground is known every point is that high.
    """
    pixels = [(row, column) for row, column in project_bev(points, config, pixel_size).tolist()]
    tall = set()
    for pixel, (x, y, z) in zip(pixels, points.tolist()):
        block = _block(x, y, config)
        if block not in means or _centimetres(z) - means[block] >= round(100 * clearance):
            tall.add(pixel)
    return np.array(
        [
            not any((row + dy, column + dx) in tall for dy in range(-2, 3) for dx in range(-2, 3))
            for row, column in pixels
        ],
        dtype=bool,
    )


def _block(x: float, y: float, config: Config) -> Tuple[int, int]:
    x0, y0 = config.point_cloud_range[:2]
    return int(np.floor((y - y0) / 2.0)), int(np.floor((x - x0) / 2.0))


def _centimetres(z: float) -> int:
    """Height in whole centimetres, rounded down; beyond a hundred thousand kilometres it stays there."""
    return int(min(max(np.floor(z * 100), -1e10), 1e10))
