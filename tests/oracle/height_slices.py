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


class SlicedSweeps(NamedTuple):
    """One window as the verified method sees it, sweep by sweep: t+1, t, t-1, ..., then t+2, ...

    Attributes:
        clouds: the points that are drawn.
        images: slices of the occupied pixels, bit c = a point of slice c lies there.
        elapsed, seconds: from each sweep to t+1, in sweep intervals and in seconds.
        size: s, metres.
        lower: (x, y), metres, corner of the region.
        shape: rows and columns.
    """

    clouds: list[list[SweepPoint]]
    images: list[dict[Cell, int]]
    elapsed: list[float]
    seconds: list[float]
    size: float
    lower: Vector
    shape: Cell

    def pixel(self, x: float, y: float) -> Cell:
        """Eq. 3d_to_bev."""
        return math.floor((y - self.lower[1]) / self.size), math.floor((x - self.lower[0]) / self.size)

    def drawn(self, clouds: list[list[SweepPoint]]) -> SlicedSweeps:
        """The same window with other points."""
        images: list[dict[Cell, int]] = [{} for _ in clouds]
        for image, cloud in zip(images, clouds):
            for x, y, z, _ in cloud:
                cell = self.pixel(x, y)
                image[cell] = image.get(cell, 0) | 1 << slice_of(z)
        return self._replace(clouds=clouds, images=images)

    def pixels(self) -> list[Pixel]:
        """The occupied pixels, sweep by sweep, in raster order."""
        return [(m, *cell) for m, image in enumerate(self.images) for cell in sorted(image)]

    def others(self, m: int) -> Iterable[int]:
        """The sweeps that a sweep is compared with: t+1 with all others, the others with t+1."""
        return [0] if m > 0 else range(1, len(self.images))

    def at(self, m: int, row: int, col: int) -> int:
        """The slices of a pixel; none outside the image."""
        return self.images[m].get((row, col), 0)

    def around(self, m: int, row: int, col: int) -> int:
        """The slices that any of the 3 x 3 pixels around a place has; none if the place lies outside the image."""
        slices = 0
        if 0 <= row < self.shape[0] and 0 <= col < self.shape[1]:
            for cell in product((row - 1, row, row + 1), (col - 1, col, col + 1)):
                slices |= self.at(m, *cell)
        return slices


def empty_sweeps(elapsed: list[float], seconds: list[float], config: VerifiedConfig) -> SlicedSweeps:
    """A window without points."""
    size, (x0, y0) = config.pixel_sizes[-1], config.point_cloud_range[:2]
    return SlicedSweeps([], [], elapsed, seconds, size, (x0, y0), bev_dims(config, size))


def slice_of(z: float, height: float = SLICE_HEIGHT, num_slices: int = NUM_SLICES) -> int:
    """Slice of a height, metres: they repeat, as the ground has no fixed height in the frame of the vehicle."""
    return math.floor(z / height) % num_slices


def count(slices: int) -> int:
    """How many slices are set."""
    return bin(slices).count("1")


def shift(motion: Vector, intervals: float) -> Cell:
    """Whole pixels that a motion leads in some intervals, halves up."""
    return math.floor(motion[0] * intervals + 0.5), math.floor(motion[1] * intervals + 0.5)


def vertex(low: float, middle: float, high: float) -> float:
    """Where the parabola through three counts, one step apart, is largest: at most half a step from the middle one."""
    curve = 2 * middle - low - high
    return min(max((high - low) / (2 * curve), -0.5), 0.5) if curve > 0 else 0.0


def ground_heights(ground: Sequence[np.ndarray], config: VerifiedConfig) -> dict[Cell, int]:
    """Mean height, centimetres, of the ground around each block of 2 m x 2 m, from ground points of some sweeps.

    Convention: heights of the points of a block and of the eight around it are rounded down, then their mean is rounded
        down. Blocks with less than five such points are missing.
    """
    means, heights = {}, _listed_heights(ground, config)
    for row, col in {(r + dr, c + dc) for r, c in heights for dr, dc in product((-1, 0, 1), repeat=2)}:
        near = [h for dr, dc in product((-1, 0, 1), repeat=2) for h in heights.get((row + dr, col + dc), [])]
        if len(near) >= 5:
            means[row, col] = sum(near) // len(near)
    return means


def _listed_heights(ground: Sequence[np.ndarray], config: VerifiedConfig) -> dict[Cell, list[int]]:
    """Heights, centimetres, rounded down, of the ground points of each block."""
    heights: dict[Cell, list[int]] = {}
    for points in ground:
        for x, y, z in points[in_range(points, config)].tolist():
            heights.setdefault(_block(x, y, config), []).append(math.floor(z * 100))
    return heights


def ground_slope(ground: Sequence[np.ndarray], centre: Vector, config: VerifiedConfig) -> Vector:
    """Slope in x and y of a plane through the ground of the 5 x 5 blocks around a centre; (0, 0) = not known.

    Convention: a block counts with its mean height, whole millimetres, rounded down, if it has five ground points. The
        plane is fitted three times, each time without the blocks that are more than 100 mm from the last one. Its
        variances in x and y must not be small: a determinant of a quarter. A slope of more than 0.3 is not ground.
    """
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    x, y = min(max(centre[0], x0), x1), min(max(centre[1], y0), y1)
    row, col = _block(x, y, config)
    known = []
    for (r, c), heights in _listed_heights(ground, config).items():
        if abs(r - row) <= 2 and abs(c - col) <= 2 and len(heights) >= 5:
            known.append((c - col, r - row, 10 * sum(heights) // len(heights)))
    used = known
    for _ in range(3):
        if len(used) < 5 or np.linalg.det(np.cov(np.array(used).T[:2], bias=True)) < 0.25 - 1e-9:
            return 0.0, 0.0
        design = np.array([(dx, dy, 1.0) for dx, dy, _ in used])
        a, b, c = np.linalg.lstsq(design, np.array([h for *_, h in used]), rcond=None)[0]
        used = [(dx, dy, h) for dx, dy, h in known if abs(h - a * dx - b * dy - c) <= 100 + 1e-6]
    slope = float(a) / 1000 / GROUND_BLOCK, float(b) / 1000 / GROUND_BLOCK
    return slope if math.hypot(*slope) <= 0.3 else (0.0, 0.0)


def is_residue(points: np.ndarray, means: dict[Cell, int], config: VerifiedConfig) -> np.ndarray:
    """(N,) bool: which of the points (N, 3) of a sweep stand on pixels that are ground.

    Convention: a pixel is not ground if a point of it, or of a pixel at most two rows and two columns away, lies
        `min_height` or more above the ground of its own block, or if no ground is known there.
    """
    assert config.min_height is not None
    sweeps = empty_sweeps([], [], config)
    tall = set()
    for x, y, z in points.tolist():
        block = _block(x, y, config)
        if block not in means or math.floor(z * 100) - means[block] >= round(100 * config.min_height):
            tall.add(sweeps.pixel(x, y))
    near = {(r + dr, c + dc) for r, c in tall for dr, dc in product(range(-2, 3), repeat=2)}
    return np.array([sweeps.pixel(x, y) not in near for x, y, _ in points.tolist()], dtype=bool)


def _block(x: float, y: float, config: VerifiedConfig) -> Cell:
    x0, y0 = config.point_cloud_range[:2]
    return math.floor((y - y0) / GROUND_BLOCK), math.floor((x - x0) / GROUND_BLOCK)
