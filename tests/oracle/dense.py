"""Oracle of CorrelationFlow at one scale: the motion of every cluster (Alg. general_correlation_flow).

Order of reading: general_correlation_flow -> scene_flow_1obj (Alg. scene_flow_1obj) -> scene_flow_in_1view
(Alg. scene_flow_1view) -> overlap_and_energy (Eq. norm_correlation); pool (Sec. leverage_past_pcs).
"""

from __future__ import annotations

import math
from statistics import median
from typing import Sequence

import numpy as np

from cflow_torch.config import DenseConfig
from oracle.clustering import cluster, cluster_hdbscan
from oracle.pixels import Box, bev_dims, bounding_box, in_range, occupancy, project_bev, search_radius
from oracle.sweeps import Cloud, PointMotion


def general_correlation_flow(
    clouds: Sequence[Cloud], cloud1: Cloud, pixel_size: float, config: DenseConfig
) -> PointMotion:
    """Cluster, find the motion of each cluster, assign it to the cluster's points (Alg. general_correlation_flow).

    `clouds` are the sweeps m = t, t-1, ... nearest first.
    """
    # Partition the aggregation of all sweeps into clusters.
    sweeps = [cloud1, *clouds]
    height, width = bev_dims(config, pixel_size)
    inside = [cloud.is_active & in_range(cloud.points, config) for cloud in sweeps]
    pixels = [project_bev(cloud.points[keep], config, pixel_size) for cloud, keep in zip(sweeps, inside)]
    if config.clustering == "hdbscan":
        members = cluster_hdbscan([cloud.points[keep] for cloud, keep in zip(sweeps, inside)], pixels, config)
    else:
        images = [occupancy(pixel, (0, 0, height, width)) for pixel in pixels]
        clusters = cluster(images, pixel_size, config.max_extent, config.connectivity)
        members = [clusters[pixel[:, 0], pixel[:, 1]] for pixel in pixels]
    cluster_ids = []
    for cloud, keep, member in zip(sweeps, inside, members):
        ids = np.full(len(cloud.points), -1, dtype=np.int64)
        ids[keep] = member
        cluster_ids.append(ids)

    flows, score = [np.zeros(cloud.points.shape) for cloud in clouds], np.zeros(len(clouds[0].points))
    for i in range(max(int(ids.max(initial=-1)) for ids in cluster_ids) + 1):
        # The cluster's scene flow: one estimate per sweep that has points of it, nearest first.
        members = [ids == i for ids in cluster_ids]
        points = [cloud.points[member] for cloud, member in zip(sweeps, members)]
        box = bounding_box([project_bev(p, config, pixel_size) for p in points])
        estimates, peaks = [], []
        for cloud, points_m in zip(clouds, points[1:]):
            if len(points_m) > 0:
                reach = search_radius(config, cloud.seconds, pixel_size)
                flow, peak = scene_flow_1obj(points_m, points[0], box, reach, pixel_size, config)
                estimates.append(flow / cloud.intervals)
                peaks.append(peak)
        # Assign it to the cluster's points.
        for flow, member in zip(flows, members[1:]):
            flow[member] = pool(estimates)
        score[members[1]] = peaks[0]
    return PointMotion(flows, cluster_ids[1], score)


def scene_flow_1obj(
    points_m: np.ndarray,
    points_1: np.ndarray,
    box: Box,
    reach: float | None,
    pixel_size: float,
    config: DenseConfig,
) -> tuple[np.ndarray, float]:
    """Find the motion of one object from sweep m to sweep t+1 (Alg. scene_flow_1obj).

    Args:
        points_m: (N, 3) float64, the object at m, frame of t+1.
        points_1: (K, 3) float64, the object at t+1.
        box: BEV pixels of the object in all sweeps.
        reach: longest displacement searched in the BEV, pixels; None = no limit.

    Returns:
        f_{m -> t+1} (3,) float64 in metres (z = 0 without the sectional view), and the NCC score of the BEV.

    Convention:
        The heading is (f_x, f_y) / norm, which are cos and sin of theta; (1, 0) for a static object. The pixels of the
        sectional view start at the origin of the frame of t+1. Its image is the box of both sweeps; rows come from z.
    """
    template, target = (occupancy(project_bev(points, config, pixel_size), box) for points in (points_m, points_1))
    (f_x, f_y), score = scene_flow_in_1view(template, target, pixel_size, reach)
    if not config.sectional_view:
        return np.array([f_x, f_y, 0.0]), score

    norm = math.sqrt(f_x * f_x + f_y * f_y)
    cos, sin = (f_x / norm, f_y / norm) if norm > 0 else (1.0, 0.0)
    translated = points_m + np.array([f_x, f_y, 0.0])
    sections = []
    for points in (translated, points_1):
        x_along = cos * points[:, 0] + sin * points[:, 1]
        row, column = np.floor(points[:, 2] / pixel_size), np.floor(x_along / pixel_size)
        sections.append(np.stack([row, column], axis=1).astype(np.int64))
    section_box = bounding_box(sections)
    template, target = (occupancy(section, section_box) for section in sections)
    (f_along, f_z), _ = scene_flow_in_1view(template, target, pixel_size)
    return np.array([f_x + f_along * cos, f_y + f_along * sin, f_z]), score


def scene_flow_in_1view(
    template: np.ndarray, target: np.ndarray, pixel_size: float, reach: float | None = None
) -> tuple[tuple[float, float], float]:
    """Find the displacement with the highest NCC score (Alg. scene_flow_1view, Eq. displacement_in_bev).

    Args:
        template: (H, W) bool, image of sweep m, at least one pixel.
        target: (H, W) bool, image of sweep t+1 of the same box.
        reach: longest displacement searched, pixels; None = no limit.

    Returns:
        (column displacement, row displacement) in metres, and the NCC score.

    Convention:
        Scores are compared as c^2 / E_w, the square of Eq. norm_correlation without its constant factor. Ties:
        smallest norm, then smallest row displacement, then smallest column displacement.
    """
    overlap, window_energy = overlap_and_energy(template, target)
    height, width = template.shape
    rank = np.zeros((height, width))
    np.divide(overlap * overlap, window_energy, out=rank, where=window_energy > 0)
    candidates = []
    for u_y, u_x in np.ndindex(height, width):
        dy, dx = u_y - height // 2, u_x - width // 2
        if reach is None or dx * dx + dy * dy <= reach * reach:
            candidates.append((-rank[u_y, u_x], dx * dx + dy * dy, dy, dx))
    _, _, dy, dx = min(candidates)
    u = dy + height // 2, dx + width // 2
    score = overlap[u] / math.sqrt(template.sum() * window_energy[u]) if overlap[u] > 0 else 0.0
    return (dx * pixel_size, dy * pixel_size), float(score)


def ncc_map(template: np.ndarray, target: np.ndarray) -> np.ndarray:
    """R[u_y, u_x] of Eq. norm_correlation for every pixel u, (H, W) float64 in [0, 1]; 0 for an empty neighbourhood."""
    overlap, window_energy = overlap_and_energy(template, target)
    energy = template.sum() * window_energy
    scores = np.zeros(energy.shape)
    np.divide(overlap, np.sqrt(energy), out=scores, where=energy > 0)
    return scores


def overlap_and_energy(template: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the numerator and the right-hand energy of Eq. norm_correlation; the images are binary.

    Returns:
        Two (H, W) int64 maps over u: the number of template pixels that fall on a target pixel when the template's
        corner lies at u - floor(size / 2), and the number of target pixels in that H x W neighbourhood. Pixels outside
        the target are 0.
    """
    height, width = template.shape
    half_h, half_w = height // 2, width // 2
    counts = target.astype(np.int32)
    overlap = np.zeros((height, width), dtype=np.int32)
    for r, c in np.argwhere(template).tolist():
        # Template pixel (r, c) lies at (u_y - half_h + r, u_x - half_w + c): the target moved by (half - pixel).
        down, right = half_h - r, half_w - c
        overlap[max(down, 0) : height + down, max(right, 0) : width + right] += counts[
            max(-down, 0) : height - down, max(-right, 0) : width - right
        ]
    energy = np.zeros((height, width), dtype=np.int32)
    for i, j in np.argwhere(target).tolist():
        # Target pixel (i, j) is in the neighbourhood of u if u - half <= pixel < u - half + size.
        bottom, right = i + half_h, j + half_w
        energy[max(bottom - height + 1, 0) : bottom + 1, max(right - width + 1, 0) : right + 1] += 1
    return overlap.astype(np.int64), energy.astype(np.int64)


def pool(estimates: Sequence[np.ndarray]) -> np.ndarray:
    """Median of the magnitudes and of the orientations, separately (Sec. leverage_past_pcs).

    Args:
        estimates: at least one estimate of f_{t -> t+1}, (3,) float64 each, nearest sweep first.

    Returns:
        (3,) float64; z is the median of the z components.

    Convention:
        One estimate is returned unchanged. Even number: the mean of the middle two. Estimates of length 0 count among
        the magnitudes, but have no orientation; if all have length 0 the result is (0, 0). The median orientation is
        taken about the circular mean. If opposite estimates cancel it, it is taken about the nearest one.
    """
    if len(estimates) == 1:
        return np.array(estimates[0], dtype=np.float64)
    magnitudes, directions = [], []
    for f_x, f_y, _ in (estimate.tolist() for estimate in estimates):
        magnitude = math.sqrt(f_x * f_x + f_y * f_y)
        magnitudes.append(magnitude)
        if magnitude > 0:
            directions.append((f_x / magnitude, f_y / magnitude))
    magnitude = median(magnitudes)
    u_x, u_y = median_direction(directions) if directions else (0.0, 0.0)
    return np.array([magnitude * u_x, magnitude * u_y, median([float(estimate[2]) for estimate in estimates])])


def median_direction(directions: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Angular median of unit vectors about their circular mean. Even number: the bisector of the middle two.

    Convention: equal angles keep the given order. If the middle two are exactly opposite, the first of them is taken.
    """
    mean_x, mean_y = 0.0, 0.0
    for u_x, u_y in directions:
        mean_x, mean_y = mean_x + u_x, mean_y + u_y
    if mean_x == 0 and mean_y == 0:
        mean_x, mean_y = directions[0]

    def angle(u: tuple[float, float]) -> float:
        """Angle from the mean to u, counter-clockwise."""
        return math.atan2(mean_x * u[1] - mean_y * u[0] + 0.0, mean_x * u[0] + mean_y * u[1])

    ordered = sorted(directions, key=angle)
    middle = len(ordered) // 2
    if len(ordered) % 2 == 1:
        return ordered[middle]
    first, second = ordered[middle - 1], ordered[middle]
    w_x, w_y = first[0] + second[0], first[1] + second[1]
    norm = math.sqrt(w_x * w_x + w_y * w_y)
    return (w_x / norm, w_y / norm) if norm > 0 else first
