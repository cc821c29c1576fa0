"""Low points that are not drawn: those near a moving pixel of t move with it."""

from __future__ import annotations

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.height_slices import SlicedSweeps, block_heights, blocks_of, over_squares
from oracle.pixels import project_bev

NEAR, LOWEST, BLOCK = 0.5, 10, 1.6  # metres, centimetres, metres


def pixels_of_low_points(
    sweeps: SlicedSweeps, points: np.ndarray, moves: np.ndarray, ground: np.ndarray, config: VerifiedConfig
) -> np.ndarray:
    """(K,): the moving pixel of t nearest to each of the points (K, 3) of t; -1 = none, -2 = none, but moving pixels of
    t are beside the point, in its block of 1.6 m or in one of the eight around.

    `moves` tells which of the P pixels move. The pixel is at most half a metre away in rows and in columns, ties: the
    first one. A point less than 10 cm above the ground, the mean of the 3 x 3 blocks around it, has none.
    """
    block = blocks_of(points, config)
    total, number = (over_squares(values, 1, np.add)[block] for values in block_heights(ground, config))
    is_ground = np.floor(points[:, 2] * 100) - total // np.maximum(number, 1) < LOWEST
    reach, side = round(NEAR / sweeps.size), round(BLOCK / sweeps.size)
    moving = np.flatnonzero(moves & (sweeps.pixels[:, 0] == 1))
    found = np.full(len(points), -1)
    for i, place in enumerate(project_bev(points, config, sweeps.size)):
        pixels = sweeps.pixels[moving, 1:]
        if (np.abs(pixels // side - place // side).max(1) <= 1).any():
            found[i] = -2
        offset = pixels - place
        near = np.abs(offset).max(1) <= reach
        if near.any() and not is_ground[i]:
            square = np.where(near, (offset**2).sum(1), np.iinfo(np.int64).max)
            found[i] = moving[square.argmin()]
    return found
