"""Refinement: the motion of objects from whole pixels to centimetres, with turns and slow motion."""

from __future__ import annotations

from typing import Dict, List, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.deskewing import register_deskewed
from oracle.height_slices import Pixel, SlicedSweeps, Vector
from oracle.rigid_registration import RigidMotion, register
from oracle.slow_motion import NUM_LAYERS, leans, slow_motion
from oracle.subpixel_shift import shift_between_pixels
from oracle.voxel_centroids import points_of_objects


def settle(
    sweeps: SlicedSweeps,
    motions: Sequence[Vector],
    may_creep: Sequence[bool],
    object_of: Dict[Pixel, int],
    clouds: Sequence[np.ndarray],
    config: VerifiedConfig,
    times: Optional[Sequence[np.ndarray]] = None,
) -> Tuple[List[RigidMotion], List[RigidMotion]]:
    """Where objects have gone in metres, between the pixels, and where the images show them to have gone.

    Args:
        sweeps: the window.
        motions: of each object (y, x), finest pixels per sweep interval.
        may_creep: of each object, whether it may move slowly if it has not moved so far.
        object_of: object of each pixel that belongs to one.
        clouds: (N, 3) float64 of t+1, t, t-1, ..., the points that are drawn.
        times: (N,) of each of them, sweep intervals; None = there are none.

    Convention: only pairs of sweeps have slow motion, as with history slow objects leave their pixels, and are shifted
        between the pixels, as with history one of many sweeps would decide.
    """
    size, is_pair = sweeps.pixel_size, len(sweeps.images) == 2
    if not config.thorough:
        moved = [RigidMotion((x * size, y * size), 0.0, (0.0, 0.0)) for y, x in motions]
        return moved, moved
    slow: List[Optional[Vector]] = [None] * len(motions)
    if is_pair:
        members: List[List[Pixel]] = [[] for _ in motions]
        for pixel, owner in object_of.items():
            members[owner].append(pixel)
        asked = [
            may and not any(motion) and leans(sweeps, own) for may, motion, own in zip(may_creep, motions, members)
        ]
        cubes = points_of_objects(asked, object_of, clouds, config, size, NUM_LAYERS)
        slow = slow_motion(cubes, len(motions), sweeps)
    points = points_of_objects([any(motion) for motion in motions], object_of, clouds, config, times=times)
    if is_pair:
        motions = shift_between_pixels(points, motions, sweeps)
        points = [point for point in points if any(motions[point.owner])]
    start = [(x * size, y * size) for y, x in motions]
    found = register(points, start, sweeps)
    seen = [motion if flow is None else motion._replace(flow=flow) for motion, flow in zip(found, slow)]
    return (seen if times is None else register_deskewed(points, start, seen, sweeps, config)), seen
