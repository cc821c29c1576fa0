"""CorrelationFlow-Keypoints at one scale: match boundary pixels of I_t and I_{t+1}, then spread their flow.

Order of reading: correlation_flow_keypoints -> `matching` (Sec. Keypoints, Descriptor, Matching keypoints) ->
median_of_components or nearest_match (Sec. From sparse to dense). Displacements are pixels until the last step of
correlation_flow_keypoints multiplies them by s.
"""

from __future__ import annotations

from typing import NamedTuple, Sequence

import numpy as np

from cflow_torch.config import KeypointsConfig
from oracle.clustering import cluster, connected_components
from oracle.history import median
from oracle.matching import Match, match_keypoints
from oracle.pixels import bev_dims, in_range, occupancy, project_bev, search_radius
from oracle.sweeps import Cloud, PointMotion


class Shift(NamedTuple):
    """What the points of one component, or of one match, are given: displacement in pixels, and NCC score."""

    dx: float
    dy: float
    score: float


def correlation_flow_keypoints(
    clouds: Sequence[Cloud], cloud1: Cloud, pixel_size: float, config: KeypointsConfig
) -> PointMotion:
    """Sec. CorrelationFlow-Keypoints: detect, describe, match, and spread the matches over the points of t.

    Args:
        clouds: sweep t alone; this method takes no older sweep.
        cloud1: sweep t+1.
        pixel_size: s in metres.

    Convention:
        With `densify="components"` the id is the component of I_t as it is, with "clusters" that of Alg. clustering on
        I_t alone, also of one without a match; with "nearest" it is the number of the match.
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
            # Alg. clustering keeps what is there before and at t+1: with I_t for both, everything
            ids = cluster([image, image], pixel_size, config.max_extent, config.connectivity)
        else:
            ids = connected_components(image, config.connectivity)[0] - 1
        shifts = median_of_components(ids, matches)

    flow, score = np.zeros(cloud.points.shape), np.zeros(len(cloud.points))
    cluster_id = np.full(len(cloud.points), -1, dtype=np.int64)
    for i, (r, c) in zip(np.flatnonzero(inside).tolist(), pixels.tolist()):
        cluster_id[i] = ids[r, c]
        if ids[r, c] >= 0:
            shift = shifts[ids[r, c]]
            flow[i] = shift.dx * pixel_size, shift.dy * pixel_size, 0.0
            score[i] = shift.score
    return PointMotion([flow], cluster_id, score)


def match_radius(config: KeypointsConfig, seconds: float, pixel_size: float) -> float:
    """Longest displacement of a match in pixels (not in the paper): `gate_radius` metres per 0.1 s, and `max_speed`."""
    reach = config.gate_radius * (seconds / 0.1) / pixel_size
    limit = search_radius(config, seconds, pixel_size)
    return reach if limit is None else min(reach, limit)


def median_of_components(ids: np.ndarray, matches: Sequence[Match]) -> list[Shift]:
    """Sec. From sparse to dense: the median flow of the matched key points of each connected component of I_t.

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
    """Every occupied pixel takes the flow of the nearest matched key point (Table keypoint_sparse2dense).

    Args:
        image: (H, W) bool, I_t.
        matches: the accepted ones, in raster order.

    Returns:
        (H, W) int64 number of the match of every occupied pixel, -1 elsewhere and where there is no match at all;
        and the shift of each match.

    Convention:
        Equally near: the first in raster order, that is smallest row, then smallest column.
    """
    ids = np.full(image.shape, -1, dtype=np.int64)
    if matches:
        rows, columns = np.array([(match.row, match.column) for match in matches]).T
        for r, c in np.argwhere(image).tolist():
            # argmin gives the first of equals
            ids[r, c] = np.argmin((rows - r) * (rows - r) + (columns - c) * (columns - c))
    return ids, [Shift(match.dx, match.dy, match.score) for match in matches]
