"""Height-sliced sweeps: which of four layers of the scene a BEV pixel of each sweep has points in."""

from __future__ import annotations

import math
from typing import List, NamedTuple, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.pixels import bev_dims, project_bev

NUM_SLICES = 4
SLICE_HEIGHT = 0.5  # metres

Pixel = Tuple[int, int, int]  # sweep (0 = t+1, 1 = t, ...), row, column
Vector = Tuple[float, float]


class SlicedSweeps(NamedTuple):
    """One window as the verified method sees it.

    Attributes:
        images: (H, W) uint8 of t+1, t, t-1, ... at the finest pixels; bit c = a point of slice c lies there.
        elapsed: sweep intervals from each sweep to t+1, 0 for t+1.
        seconds: the same in seconds.
        pixel_size: s, metres.
        lower: (x, y), metres, corner of the region.
    """

    images: List[np.ndarray]
    elapsed: List[float]
    seconds: List[float]
    pixel_size: float
    lower: Vector

    def pixels(self) -> List[Pixel]:
        """The occupied pixels, sweep by sweep, in raster order."""
        return [(m, r, c) for m, image in enumerate(self.images) for r, c in np.argwhere(image).tolist()]

    def at(self, m: int, row: int, col: int) -> int:
        """The slices of a pixel; none outside the image."""
        height, width = self.images[m].shape
        return int(self.images[m][row, col]) if 0 <= row < height and 0 <= col < width else 0


def slice_image(points: np.ndarray, config: VerifiedConfig) -> np.ndarray:
    """(H, W) uint8: image of one sweep, four bits a pixel: bit c is set if a point of slice c lies there.

    Args:
        points: (N, 3) float64, metres, frame of t+1, all of them inside the range.
        config: for the finest pixels.
    """
    size = config.pixel_sizes[-1]
    image = np.zeros(bev_dims(config, size), dtype=np.uint8)
    for (r, c), z in zip(project_bev(points, config, size).tolist(), points[:, 2].tolist()):
        image[r, c] |= 1 << slice_of(z)
    return image


def slice_of(z: float, height: float = SLICE_HEIGHT, num_slices: int = NUM_SLICES) -> int:
    """Slice of a height, metres: they repeat, as the ground has no fixed height in the frame of the vehicle."""
    return math.floor(z / height) % num_slices


def coarsen(image: np.ndarray, block: int) -> np.ndarray:
    """The image at pixels of `block` x `block` finest ones, which have the slices of all of those."""
    height, width = image.shape
    coarse = np.zeros((-(-height // block), -(-width // block)), dtype=np.uint8)
    for r, c in np.argwhere(image).tolist():
        coarse[r // block, c // block] |= image[r, c]
    return coarse


def count(slices: int) -> int:
    """How many slices are set."""
    return bin(slices).count("1")


def shared(sweeps: SlicedSweeps, pixels: Sequence[Pixel], other: int, dy: int, dx: int) -> int:
    """Slices of some pixels that another sweep has dy rows and dx columns away."""
    return sum(count(sweeps.at(m, r, c) & sweeps.at(other, r + dy, c + dx)) for m, r, c in pixels)


def vertex(low: float, middle: float, high: float) -> float:
    """Where the parabola through three counts, one step apart, is largest: at most half a step from the middle one."""
    curve = 2 * middle - low - high
    return min(max((high - low) / (2 * curve), -0.5), 0.5) if curve > 0 else 0.0
