"""Key points as candidates of the proof: matches t -> t+1 at one pixel size, and their median in a component."""

from __future__ import annotations

from typing import List, Sequence, Tuple

import numpy as np

from cflow_torch.config import Config
from oracle.candidates import Vector
from oracle.keypoints import gate
from oracle.matching import match_keypoints
from oracle.pooling import median
from oracle.sweeps import Cloud


def keypoint_shifts(images: Sequence[np.ndarray], cloud: Cloud, block: int, config: Config) -> np.ndarray:
    """Displacement t -> t+1 of the finest pixels that lie in a matched key point.

    Args:
        images: (H, W) uint8 of sweep t+1, then of t, at the finest pixels; 0 = not occupied.
        cloud: sweep t.
        block: finest pixels a side of a pixel that can be a key point.
        config: settings.

    Returns:
        (H, W, 2) float64, (y, x) finest pixels; NaN where no key point was matched.
    """
    newest, at_t = (_occupancy(image, block) for image in images[:2])
    reach = gate(config, cloud.elapsed, config.pixel_sizes[-1] * block)
    shifts = np.full((*images[1].shape, 2), np.nan)
    for found in match_keypoints(at_t, newest, reach, config):
        rows, cols = (slice(v * block, (v + 1) * block) for v in (found.row, found.column))
        shifts[rows, cols] = found.dy * block, found.dx * block
    return shifts


def keypoint_motion(member: np.ndarray, shifts: np.ndarray) -> Vector:
    """The median of each axis over the pixels of a component at t that were matched; (0, 0) if none was.

    Args:
        member: (H, W) bool, pixels of the component in sweep t.
        shifts: as `keypoint_shifts` gives them.
    """
    matched: List[Tuple[float, float]] = [(y, x) for y, x in shifts[member].tolist() if not np.isnan(y)]
    if not matched:
        return 0.0, 0.0
    ys, xs = zip(*matched)
    return median(ys), median(xs)


def _occupancy(image: np.ndarray, block: int) -> np.ndarray:
    height, width = -(-image.shape[0] // block), -(-image.shape[1] // block)
    coarse = np.zeros((height, width), dtype=bool)
    for r, c in np.argwhere(image).tolist():
        coarse[r // block, c // block] = True
    return coarse
