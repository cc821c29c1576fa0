"""Height-sliced sweeps: which of four slices of height each BEV pixel has points in; ground residue is left out."""

from __future__ import annotations

from functools import reduce
from itertools import product
from typing import Callable, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.pixels import bev_dims, in_range, project_bev

NUM_SLICES, SLICE_HEIGHT = 4, 0.5  # metres
GROUND_BLOCK = 2.0  # metres
COUNT = np.array([bin(slices).count("1") for slices in range(1 << NUM_SLICES)])

Vector = Tuple[float, float]


class SlicedSweeps:
    """One window as the verified method sees it, sweep by sweep: t+1, t, t-1, ..., then t+2, ...

    Args:
        clouds: (N, 3) of each sweep, the points that are drawn.
        elapsed, seconds: from each sweep to t+1, in sweep intervals and in seconds.

        reach: (H, W), pixels around each pixel that the spacing of points covers; None = 1.
        is_tall: (H, W) bool, the slices above and below those around count as well.

    Attributes:
        image, around: (S, H, W), bit c = a point of slice c lies in the pixel, or within its reach.
        both: (S, H, W), `image`, and `around` in the next four bits.
        pixels: (P, 3), sweep, row and column of the occupied pixels, in this order.
        slices: (P,), of these pixels.
        number: (S, H, W), position of each pixel in this list, -1 = none.
        pixel_of_point: (N,), of the points of all clouds.
    """

    def __init__(
        self,
        clouds: Sequence[np.ndarray],
        elapsed: Sequence[float],
        seconds: Sequence[float],
        config: VerifiedConfig,
        reach: np.ndarray | None = None,
        is_tall: np.ndarray | bool = False,
    ) -> None:
        self.elapsed, self.seconds, self.config = np.array(elapsed), seconds, config
        self.has_history = len(elapsed) > 2
        self.size, self.lower = config.pixel_sizes[-1], np.array(config.point_cloud_range[:2])
        self.points = np.concatenate(clouds)
        index = (
            np.repeat(range(len(clouds)), [len(cloud) for cloud in clouds]),
            *project_bev(self.points, config, self.size).T,
        )
        self.image = np.zeros((len(clouds), *bev_dims(config, self.size)), dtype=int)
        np.bitwise_or.at(self.image, index, 1 << slice_of(self.points[:, 2]))
        self.reach = np.ones(self.image.shape[1:], dtype=int) if reach is None else reach
        self.around = np.zeros_like(self.image)
        for pixels in np.unique(self.reach).tolist():
            around = over_squares(self.image, pixels, np.bitwise_or)
            self.around = np.where(self.reach == pixels, around, self.around)
        above, below = (self.around << 1 | self.around >> 3) & 15, (self.around >> 1 | self.around << 3) & 15
        self.around = np.where(is_tall, self.around | above | below, self.around)
        self.both = self.image | self.around << NUM_SLICES
        self.pixels, self.slices = np.argwhere(self.image), self.image[self.image > 0]
        self.number = np.where(self.image > 0, np.cumsum(self.image > 0).reshape(self.image.shape) - 1, -1)
        self.pixel_of_point = self.number[index]

    def middle(self, pixels: np.ndarray) -> np.ndarray:
        """(K, 2): x and y of the middles of pixels (K, 3), metres."""
        return (pixels[:, :0:-1] + 0.5) * self.size + self.lower


def value_at(image: np.ndarray, *index: np.ndarray) -> np.ndarray:
    """Values of an image at indices along each of its axes; 0 outside."""
    inside = np.logical_and.reduce([(axis >= 0) & (axis < size) for axis, size in zip(index, image.shape)])
    return np.where(inside, image[tuple(np.where(inside, axis, 0) for axis in index)], 0)


def over_squares(image: np.ndarray, reach: int, combine: Callable[..., np.ndarray]) -> np.ndarray:
    """Combine, for each pixel of (..., H, W), those at most `reach` rows and columns away."""
    padded = np.pad(image, [(0, 0)] * (image.ndim - 2) + [(reach, reach)] * 2)
    rows, cols = image.shape[-2:]
    shifts = product(range(2 * reach + 1), repeat=2)
    return reduce(combine, (padded[..., row : row + rows, col : col + cols] for row, col in shifts))


def slice_of(z: np.ndarray, height: float = SLICE_HEIGHT, num_slices: int = NUM_SLICES) -> np.ndarray:
    """Slice of a height, metres: they repeat, as the ground has no fixed height in the frame of the vehicle."""
    return (np.floor(z / height) % num_slices).astype(int)


def blocks_of(points: np.ndarray, config: VerifiedConfig) -> tuple[np.ndarray, ...]:
    """Row and column of the block of 2 m x 2 m of each point."""
    return tuple(project_bev(points, config, GROUND_BLOCK).T)


def block_heights(ground: np.ndarray, config: VerifiedConfig) -> tuple[np.ndarray, np.ndarray]:
    """Sum of the heights, centimetres, each rounded down, of the ground points (N, 3) of each block; their number."""
    total, number = np.zeros((2, *bev_dims(config, GROUND_BLOCK)))
    ground = ground[in_range(ground, config)]
    np.add.at(total, blocks_of(ground, config), np.floor(ground[:, 2] * 100))
    np.add.at(number, blocks_of(ground, config), 1)
    return total, number


def is_residue(points: np.ndarray, ground: np.ndarray, config: VerifiedConfig) -> np.ndarray:
    """(N,) bool: which of the points (N, 3) of a sweep stand on pixels that are ground.

    Convention: a pixel is not ground if a point of it, or of a pixel at most two rows and two columns away, lies
        `min_height` or more above the ground of its own block, or if no ground is known there. That is the mean of the
        block and of the eight around it, rounded down, if these have five ground points.
    """
    assert config.min_height is not None
    block = blocks_of(points, config)
    total, number = (over_squares(values, 1, np.add)[block] for values in block_heights(ground, config))
    height = np.floor(points[:, 2] * 100) - total // np.maximum(number, 1)
    is_tall = (number < 5) | (height >= round(100 * config.min_height))
    pixel = tuple(project_bev(points, config, config.pixel_sizes[-1]).T)
    image = np.zeros(bev_dims(config, config.pixel_sizes[-1]), dtype=bool)
    image[tuple(axis[is_tall] for axis in pixel)] = True
    return ~over_squares(image, 2, np.logical_or)[pixel]


def ground_slope(ground: np.ndarray, centre: Vector, config: VerifiedConfig) -> Vector:
    """Slope in x and y of a plane through the ground of the 5 x 5 blocks around a centre; (0, 0) = not known.

    Convention: a block counts with its mean height, whole millimetres, rounded down, if it has five ground points. The
        plane is fitted three times, each time without the blocks that are more than 100 mm from the last one. Its
        variances in x and y must not be small: a determinant of a quarter. A slope of more than 0.3 is not ground.
    """
    x0, y0, _, x1, y1, _ = config.point_cloud_range
    middle = np.array(blocks_of(np.clip(np.array([centre]), (x0, y0), (x1, y1)), config))
    total, number = block_heights(ground, config)
    at = np.argwhere(number >= 5)
    at = at[(np.abs(at - middle.T) <= 2).all(1)]
    heights = 10 * total[tuple(at.T)] // number[tuple(at.T)]
    places = np.column_stack((at[:, ::-1] - middle[::-1, 0], np.ones(len(at))))
    used = np.ones(len(at), dtype=bool)
    for _ in range(3):
        if used.sum() < 5 or np.linalg.det(np.cov(places[used, :2].T, bias=True)) < 0.25 - 1e-9:
            return 0.0, 0.0
        plane = np.linalg.lstsq(places[used], heights[used], rcond=None)[0]
        used = np.abs(heights - places @ plane) <= 100 + 1e-6
    x, y = plane[:2] / 1000 / GROUND_BLOCK
    return (float(x), float(y)) if np.hypot(x, y) <= 0.3 else (0.0, 0.0)
