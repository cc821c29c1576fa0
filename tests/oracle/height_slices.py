"""Height-sliced sweeps: which of four slices of height each BEV pixel has points in; ground residue is left out."""

from __future__ import annotations

import math
from itertools import product
from typing import Iterable, NamedTuple, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.pixels import bev_dims, in_range

NUM_SLICES, SLICE_HEIGHT = 4, 0.5  # metres
GROUND_BLOCK = 2.0  # metres

Cell = Tuple[int, int]  # row, column
Pixel = Tuple[int, int, int]  # sweep (0 = t+1, 1 = t, ...), row, column
Vector = Tuple[float, float]


class SweepPoint(NamedTuple):
    """A point: metres in the frame of t+1, and sweep intervals from the instant of its sweep."""

    x: float
    y: float
    z: float
    time: float = 0.0


class SlicedSweeps:
    """One window as the verified method sees it, sweep by sweep: t+1, t, t-1, ..., then t+2, ...

    Args:
        clouds: the points that are drawn.
        elapsed, seconds: from each sweep to t+1, in sweep intervals and in seconds.
        config: `pixel_sizes`, `point_cloud_range`.

    Attributes:
        images: slices of the occupied pixels, bit c = a point of slice c lies there.
        size: s, metres.
        lower: (x, y), metres, corner of the region.
        shape: rows and columns.
    """

    def __init__(
        self,
        clouds: Sequence[Sequence[SweepPoint]],
        elapsed: Sequence[float],
        seconds: Sequence[float],
        config: VerifiedConfig,
    ) -> None:
        self.clouds, self.elapsed, self.seconds, self.config = clouds, elapsed, seconds, config
        self.size, self.lower = config.pixel_sizes[-1], config.point_cloud_range[:2]
        self.shape = bev_dims(config, self.size)
        self.images: list[dict[Cell, int]] = [{} for _ in clouds]
        for image, cloud in zip(self.images, clouds):
            for x, y, z, _ in cloud:
                cell = self.cell(x, y)
                image[cell] = image.get(cell, 0) | 1 << slice_of(z)

    def with_points(self, clouds: Sequence[Sequence[SweepPoint]]) -> SlicedSweeps:
        """The same window with other points."""
        return SlicedSweeps(clouds, self.elapsed, self.seconds, self.config)

    def cell(self, x: float, y: float) -> Cell:
        """Eq. 3d_to_bev."""
        return math.floor((y - self.lower[1]) / self.size), math.floor((x - self.lower[0]) / self.size)

    def pixels(self) -> list[Pixel]:
        """The occupied pixels, sweep by sweep, in raster order."""
        return [(m, *cell) for m, image in enumerate(self.images) for cell in sorted(image)]

    def points(self) -> list[tuple[Pixel, SweepPoint]]:
        """All points, and their pixels."""
        return [((m, *self.cell(p.x, p.y)), p) for m, cloud in enumerate(self.clouds) for p in cloud]

    def others(self, m: int) -> Iterable[int]:
        """The sweeps that a sweep is compared with: t+1 with all others, the others with t+1."""
        return [0] if m > 0 else range(1, len(self.images))

    def at(self, m: int, row: int, col: int) -> int:
        """The slices of a pixel; none outside the image."""
        return self.images[m].get((row, col), 0)

    def around(self, m: int, row: int, col: int) -> int:
        """The slices that any of the 3 x 3 pixels around a pixel has; none if the pixel lies outside the image."""
        slices = 0
        if 0 <= row < self.shape[0] and 0 <= col < self.shape[1]:
            for dy, dx in NEAR:
                slices |= self.at(m, row + dy, col + dx)
        return slices


NEAR = tuple(product((-1, 0, 1), repeat=2))  # a pixel and the eight around it


def slice_of(z: float, height: float = SLICE_HEIGHT, num_slices: int = NUM_SLICES) -> int:
    """Slice of a height, metres: they repeat, as the ground has no fixed height in the frame of the vehicle."""
    return math.floor(z / height) % num_slices


def count(slices: int) -> int:
    """How many slices are set."""
    return bin(slices).count("1")


def shift(motion: Vector, intervals: float) -> Cell:
    """Whole pixels that a motion leads in some intervals, halves up."""
    return math.floor(motion[0] * intervals + 0.5), math.floor(motion[1] * intervals + 0.5)


# ------------------------------------------------------------------------------------------------ ground


def block_heights(ground: np.ndarray, config: VerifiedConfig) -> dict[Cell, list[int]]:
    """Heights, centimetres, rounded down, of the ground points (N, 3) of each block of 2 m x 2 m."""
    heights: dict[Cell, list[int]] = {}
    for x, y, z in ground[in_range(ground, config)].tolist():
        heights.setdefault(block_of(x, y, config), []).append(math.floor(z * 100))
    return heights


def block_of(x: float, y: float, config: VerifiedConfig) -> Cell:
    x0, y0 = config.point_cloud_range[:2]
    return math.floor((y - y0) / GROUND_BLOCK), math.floor((x - x0) / GROUND_BLOCK)


def is_residue(points: np.ndarray, ground: np.ndarray, config: VerifiedConfig) -> np.ndarray:
    """(N,) bool: which of the points (N, 3) of a sweep stand on pixels that are ground.

    Convention: a pixel is not ground if a point of it, or of a pixel at most two rows and two columns away, lies
        `min_height` or more above the ground of its own block, or if no ground is known there. That is the mean of the
        block and of the eight around it, rounded down, if these have five ground points.
    """
    assert config.min_height is not None
    pixel_of, heights = SlicedSweeps([], [], [], config).cell, block_heights(ground, config)
    tall = set()
    for x, y, z in points.tolist():
        row, col = block_of(x, y, config)
        near = [height for dr, dc in NEAR for height in heights.get((row + dr, col + dc), [])]
        if len(near) < 5 or math.floor(z * 100) - sum(near) // len(near) >= round(100 * config.min_height):
            tall.add(pixel_of(x, y))
    kept = {(r + dr, c + dc) for r, c in tall for dr, dc in product(range(-2, 3), repeat=2)}
    return np.array([pixel_of(x, y) not in kept for x, y, _ in points.tolist()], dtype=bool)


def ground_slope(ground: np.ndarray, centre: Vector, config: VerifiedConfig) -> Vector:
    """Slope in x and y of a plane through the ground of the 5 x 5 blocks around a centre; (0, 0) = not known.

    Convention: a block counts with its mean height, whole millimetres, rounded down, if it has five ground points. The
        plane is fitted three times, each time without the blocks that are more than 100 mm from the last one. Its
        variances in x and y must not be small: a determinant of a quarter. A slope of more than 0.3 is not ground.
    """
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    row, col = block_of(min(max(centre[0], x0), x1), min(max(centre[1], y0), y1), config)
    known = np.array(
        [
            (c - col, r - row, 1, 10 * sum(heights) // len(heights))
            for (r, c), heights in block_heights(ground, config).items()
            if abs(r - row) <= 2 and abs(c - col) <= 2 and len(heights) >= 5
        ]
    ).reshape(-1, 4)
    used = known
    for _ in range(3):
        if len(used) < 5 or np.linalg.det(np.cov(used.T[:2], bias=True)) < 0.25 - 1e-9:
            return 0.0, 0.0
        plane = np.linalg.lstsq(used[:, :3], used[:, 3], rcond=None)[0]
        used = known[np.abs(known[:, 3] - known[:, :3] @ plane) <= 100 + 1e-6]
    x, y = (plane[:2] / 1000 / GROUND_BLOCK).tolist()
    return (x, y) if math.hypot(x, y) <= 0.3 else (0.0, 0.0)
