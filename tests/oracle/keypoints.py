"""Oracle of CorrelationFlow-Keypoints at one scale: match boundary pixels of I_t and I_{t+1}, then spread their flow.

Order of reading: correlation_flow_keypoints -> match_keypoints (Sec. Keypoints, Descriptor, Matching keypoints) ->
median_of_components or nearest_match (Sec. From sparse to dense). Pixels are (row, column), displacements are pixels,
t -> t+1, until the last step of correlation_flow_keypoints multiplies them by s.
"""

from __future__ import annotations

import math
from statistics import median
from typing import NamedTuple, Sequence, Tuple

import numpy as np
from scipy import ndimage

from cflow_torch.config import KeypointsConfig
from oracle.clustering import cluster
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
    """Median shift of the matched key points of each connected component of I_t (Sec. From sparse to dense).

    Args:
        ids: (H, W) int64, component of every occupied pixel, 0 ... in raster order of its first pixel, -1 elsewhere.

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
    """Give every occupied pixel of I_t the flow of the nearest matched key point (Table keypoint_sparse2dense).

    Returns:
        (H, W) int64 number of the match of every occupied pixel, -1 elsewhere and where there is no match at all;
        and the shift of each match. Ties: the first in raster order.
    """
    ids = np.full(image.shape, -1, dtype=np.int64)
    if matches:
        rows, columns = np.array([(match.row, match.column) for match in matches]).T
        for r, c in np.argwhere(image).tolist():
            # argmin returns the first of several minima
            ids[r, c] = np.argmin((rows - r) * (rows - r) + (columns - c) * (columns - c))
    return ids, [Shift(match.dx, match.dy, match.score) for match in matches]


class Keypoints(NamedTuple):
    """Key points of one image with their descriptors, in raster order."""

    pixels: np.ndarray  # (K, 2) int64, row and column
    descriptors: np.ndarray  # (K, L * L) bool
    energies: np.ndarray  # (K,) int64, E = number of ones of each descriptor, its squared norm; at least 1, the centre


def described_keypoints(image: np.ndarray, patch_size: int) -> Keypoints:
    """Key points of an image (H, W) bool and their descriptors of side L = `patch_size`."""
    pixels = detect_keypoints(image)
    descriptors = describe(image, pixels, patch_size)
    return Keypoints(pixels, descriptors, descriptors.sum(axis=1))


def detect_keypoints(image: np.ndarray) -> np.ndarray:
    """Foreground pixels of an image (H, W) bool whose distance to the background is 1 (Sec. Keypoints): (K, 2) int64,
    row and column, in raster order. One of their 4 orthogonal neighbours is background, as is all outside the image.
    """
    padded = np.pad(image, 1)
    is_inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.argwhere(image & ~is_inside)


def describe(image: np.ndarray, keypoints: np.ndarray, patch_size: int) -> np.ndarray:
    """(K, L * L) bool: the L x L patch of an image (H, W) bool around each key point (K, 2), 0 outside the image (Sec.
    Descriptor).
    """
    patches = np.lib.stride_tricks.sliding_window_view(np.pad(image, patch_size // 2), (patch_size, patch_size))
    return patches[tuple(keypoints.T)].reshape(len(keypoints), patch_size**2)


# A key point of t+1 as a match of one of t; the smaller tuple is the better match: -c^2 / E of its descriptor, squared
# length and dy, dx of the displacement in pixels, its number, c (positions at which both descriptors are one).
Candidate = Tuple[float, int, int, int, int, int]


class Match(NamedTuple):
    """An accepted match: pixel of the key point of t, displacement to t+1 in pixels, Eq. descriptor_ncc."""

    row: int
    column: int
    dx: int
    dy: int
    score: float


def match_keypoints(image: np.ndarray, image1: np.ndarray, reach: float, config: KeypointsConfig) -> list[Match]:
    """Find Eq. best_match of every key point of t, then apply the ratio test (Sec. Matching keypoints).

    Args:
        image, image1: (H, W) bool, I_t and I_{t+1}.
        reach: longest displacement in pixels, itself allowed.

    Returns:
        The accepted matches, in raster order of their key points of t. One without a second candidate is accepted.
        Ties: smallest displacement, then smallest dy, then smallest dx.
    """
    at_t, at_t1 = (described_keypoints(i, config.patch_size) for i in (image, image1))
    matches = []
    for i, (row, column) in enumerate(at_t.pixels.tolist()):
        candidates = rank_candidates(at_t, i, at_t1, reach)
        if not candidates:
            continue
        _, _, dy, dx, best, overlap = candidates[0]
        if len(candidates) > 1:
            second, overlap2 = candidates[1][4:]
            counts = overlap, int(at_t1.energies[best]), overlap2, int(at_t1.energies[second])
            if not passes_ratio_test(*counts, config.ratio_threshold):
                continue
        score = overlap / math.sqrt(int(at_t.energies[i]) * int(at_t1.energies[best]))
        matches.append(Match(row, column, dx, dy, score))
    return matches


def rank_candidates(at_t: Keypoints, number: int, at_t1: Keypoints, reach: float) -> list[Candidate]:
    """Sort the key points of t+1 within reach of one key point of t, the best match first (Eq. best_match).

    Convention:
        Eq. descriptor_ncc is c / sqrt(E E_other). E is equal for all candidates of a key point, so c^2 / E_other ranks
        them. The float64 quotient ranks as the exact rational does. Counts are at most 51^2 = 2601, so equal rationals
        are rounded alike, and different ones differ by at least 1 / 2601^2 > 1e-7, at values of at most 2601, where
        rounding changes less than 1e-12.
    """
    dy, dx = (at_t1.pixels - at_t.pixels[number]).T
    numbers = np.flatnonzero(dx * dx + dy * dy <= reach * reach)
    dy, dx = dy[numbers], dx[numbers]
    overlap = np.count_nonzero(at_t1.descriptors[numbers] & at_t.descriptors[number], axis=1)
    rank = overlap * overlap / at_t1.energies[numbers]
    columns = (-rank, dx * dx + dy * dy, dy, dx, numbers, overlap)
    return sorted(zip(*(column.tolist() for column in columns)))


def passes_ratio_test(overlap: int, energy: int, second_overlap: int, second_energy: int, ratio: float) -> bool:
    """Test R_best > rho R_second in whole numbers (Sec. Matching keypoints).

    Convention:
        We square c1 / sqrt(E1) > rho c2 / sqrt(E2) and clear the fractions; rho = P / 10^4. A match that is exactly
        rho times as good is rejected, and so is a tie, for every rho >= 1.
    """
    p = round(ratio * 10_000)
    return overlap * overlap * second_energy * 10_000**2 > p * p * second_overlap * second_overlap * energy
