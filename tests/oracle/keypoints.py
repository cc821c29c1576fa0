"""Oracle of CorrelationFlow-Keypoints at one scale: match boundary pixels of I_t and I_{t+1}, then spread their flow.

Order of reading: correlation_flow_keypoints -> `matching` (Sec. Keypoints, Descriptor, Matching keypoints) ->
median_of_components or nearest_match (Sec. From sparse to dense). Displacements are pixels until the last step of
correlation_flow_keypoints multiplies them by s.
"""

from __future__ import annotations

from statistics import median
from typing import NamedTuple, Sequence

import numpy as np
from scipy import ndimage

from cflow_torch.config import KeypointsConfig
from oracle.clustering import cluster
from oracle.matching import Match, match_keypoints
from oracle.pixels import bev_dims, in_range, occupancy, project_bev, search_radius
from oracle.sweeps import Cloud, PointMotion


class Shift(NamedTuple):
    """Displacement in pixels and NCC score of the points of one component, or of one match."""

    dx: float
    dy: float
    score: float


def correlation_flow_keypoints(
    clouds: Sequence[Cloud], cloud1: Cloud, pixel_size: float, config: KeypointsConfig
) -> PointMotion:
    """Detect, describe, match, and spread the matches over the points of t (Sec. CorrelationFlow-Keypoints).

    Args:
        clouds: sweep t alone; this method takes no older sweep.
        cloud1: sweep t+1.
        pixel_size: s in metres.

    Convention:
        The id is the component of I_t with `densify="components"`, the component of Alg. clustering on I_t alone with
        "clusters" (in both cases also without a match), and the index of the match with "nearest".
    """
    (cloud,) = clouds
    height, width = bev_dims(config, pixel_size)
    inside, inside1 = (c.is_active & in_range(c.points, config) for c in (cloud, cloud1))
    pixels = project_bev(cloud.points[inside], config, pixel_size)
    pixels1 = project_bev(cloud1.points[inside1], config, pixel_size)
    image, image1 = (occupancy(p, (0, 0, height, width)) for p in (pixels, pixels1))

    matches = match_keypoints(image, image1, match_radius(config, cloud.seconds, pixel_size), config)
    if config.densify == "nearest":
        ids, shifts = nearest_match(image, matches)
    else:
        if config.densify == "clusters":
            # Alg. clustering keeps components that are there before and at t+1; with I_t for both it keeps all.
            ids = cluster([image, image], pixel_size, config.max_extent, config.connectivity)
        else:
            ids = ndimage.label(image, ndimage.generate_binary_structure(2, config.connectivity // 4))[0] - 1
        shifts = median_of_components(ids, matches)

    flow, score = np.zeros(cloud.points.shape), np.zeros(len(cloud.points))
    cluster_id = np.full(len(cloud.points), -1, dtype=np.int64)
    cluster_id[inside] = ids[tuple(pixels.T)]
    for number, shift in enumerate(shifts):
        flow[cluster_id == number] = shift.dx * pixel_size, shift.dy * pixel_size, 0.0
        score[cluster_id == number] = shift.score
    return PointMotion([flow], cluster_id, score)


def match_radius(config: KeypointsConfig, seconds: float, pixel_size: float) -> float:
    """Longest displacement of a match in pixels (not in the paper), from `gate_radius` (per 0.1 s) and `max_speed`."""
    reach = config.gate_radius * (seconds / 0.1) / pixel_size
    limit = search_radius(config, seconds, pixel_size)
    return reach if limit is None else min(reach, limit)


def median_of_components(ids: np.ndarray, matches: Sequence[Match]) -> list[Shift]:
    """Median flow of the matched key points of each connected component of I_t (Sec. From sparse to dense).

    Args:
        ids: (H, W) int64, component of every occupied pixel, 0 ... in raster order of its first pixel, -1 elsewhere.
        matches: the accepted ones.

    Returns:
        The shift of each component.

    Convention:
        Medians of dx, of dy and of the scores, separately; of an even number the mean of the middle two. A
        component without a match has shift 0 and score 0.
    """
    members: list[list[Match]] = [[] for _ in range(int(ids.max(initial=-1)) + 1)]
    for match in matches:
        members[ids[match.row, match.column]].append(match)
    shifts = []
    for member in members:
        if member:
            dx, dy, score = ([getattr(match, name) for match in member] for name in ("dx", "dy", "score"))
            shifts.append(Shift(median(dx), median(dy), median(score)))
        else:
            shifts.append(Shift(0.0, 0.0, 0.0))
    return shifts


def nearest_match(image: np.ndarray, matches: Sequence[Match]) -> tuple[np.ndarray, list[Shift]]:
    """Give every occupied pixel the flow of the nearest matched key point (Table keypoint_sparse2dense).

    Args:
        image: (H, W) bool, I_t.
        matches: the accepted ones, in raster order.

    Returns:
        (H, W) int64 number of the match of every occupied pixel, -1 elsewhere and where there is no match at all;
        and the shift of each match.

    Convention:
        Ties: the first in raster order, that is smallest row, then smallest column.
    """
    ids = np.full(image.shape, -1, dtype=np.int64)
    if matches:
        rows, columns = np.array([(match.row, match.column) for match in matches]).T
        for r, c in np.argwhere(image).tolist():
            # argmin returns the first of several minima
            ids[r, c] = np.argmin((rows - r) * (rows - r) + (columns - c) * (columns - c))
    return ids, [Shift(match.dx, match.dy, match.score) for match in matches]
