"""Ground residue: what a ground mask left over, found by its height above the ground around it."""

from __future__ import annotations

import math
from typing import Dict, List, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.pixels import in_range, project_bev

BLOCK = 2.0  # metres

Block = Tuple[int, int]  # row, column


def ground_heights(ground: Sequence[np.ndarray], config: VerifiedConfig) -> Dict[Block, int]:
    """Mean height of the ground around each block of 2 m x 2 m.

    Args:
        ground: (N, 3) float64 ground points, metres, frame of t+1, of each sweep that has a ground mask.
        config: `point_cloud_range`; points outside of it count nowhere.

    Returns:
        Block -> centimetres: heights of its points and of those of the eight blocks around it, each rounded down, then
        their mean, rounded down. Blocks with less than five such points are missing.
    """
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    heights: Dict[Block, List[int]] = {}
    for points in ground:
        for x, y, z in points[in_range(points, config)].tolist():
            heights.setdefault(_block(x, y, config), []).append(math.floor(z * 100))
    means = {}
    for row in range(int((y1 - y0) // BLOCK) + 1):
        for col in range(int((x1 - x0) // BLOCK) + 1):
            blocks = [(row + dy, col + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
            around = [height for block in blocks for height in heights.get(block, [])]
            if len(around) >= 5:
                means[row, col] = sum(around) // len(around)
    return means


def is_residue(points: np.ndarray, means: Dict[Block, int], min_height: float, config: VerifiedConfig) -> np.ndarray:
    """Which points of a sweep stand on pixels that are ground.

    Args:
        points: (N, 3) float64, metres, frame of t+1, inside the region.
        means: as `ground_heights` gives them.
        min_height: metres.
        config: for the finest pixels.

    Returns:
        (N,) bool: no point of the pixel, and none of a pixel at most two rows and two columns away, lies `min_height`
        or more above the ground of its own block. Where no ground is known every point is that high.
    """
    pixels = [(row, col) for row, col in project_bev(points, config, config.pixel_sizes[-1]).tolist()]
    tall = set()
    for pixel, (x, y, z) in zip(pixels, points.tolist()):
        block = _block(x, y, config)
        if block not in means or math.floor(z * 100) - means[block] >= round(100 * min_height):
            tall.add(pixel)
    near = range(-2, 3)
    return np.array([not any((r + dy, c + dx) in tall for dy in near for dx in near) for r, c in pixels], dtype=bool)


def _block(x: float, y: float, config: VerifiedConfig) -> Block:
    x0, y0 = config.point_cloud_range[:2]
    return math.floor((y - y0) / BLOCK), math.floor((x - x0) / BLOCK)
