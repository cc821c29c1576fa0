"""Height slices: which of four layers of the scene a BEV pixel has points in."""

from __future__ import annotations

import math

import numpy as np

from cflow_torch.config import Config
from oracle.pixels import bev_dims, project_bev


def slice_image(points: np.ndarray, config: Config, pixel_size: float, slice_height: float) -> np.ndarray:
    """Image of one sweep, four bits a pixel: bit c is set if a point of slice c lies there.

    Args:
        points: (N, 3) float64, metres, frame of t+1, all of them inside the range.
        config: `point_cloud_range`.
        pixel_size: s in metres.
        slice_height: metres.

    Returns:
        (H, W) uint8.

    Convention: slice c of a height z is floor(z / slice_height) mod 4, never negative. Slices repeat every four
        layers: the ground has no fixed height in the frame of the vehicle, so none can be the lowest.
    """
    image = np.zeros(bev_dims(config, pixel_size), dtype=np.uint8)
    for (r, c), z in zip(project_bev(points, config, pixel_size).tolist(), points[:, 2].tolist()):
        image[r, c] |= 1 << (math.floor(z / slice_height) % 4)
    return image
