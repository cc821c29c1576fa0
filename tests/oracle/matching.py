"""Oracle of key points, their descriptors and their matches (Sec. CorrelationFlow-Keypoints).

Pixels are (row, column), displacements are pixels, t -> t+1.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Tuple

import numpy as np

from cflow_torch.config import KeypointsConfig


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
    """Find the foreground pixels whose distance to the background is 1 (Sec. Keypoints).

    Args:
        image: (H, W) bool.

    Returns:
        (K, 2) int64, row and column, in raster order.

    Convention:
        Distance 1 means that one of the 4 orthogonal neighbours is background. Pixels outside the image are
        background, as in the zero padding of the descriptors.
    """
    padded = np.pad(image, 1)
    is_inside = padded[:-2, 1:-1] & padded[2:, 1:-1] & padded[1:-1, :-2] & padded[1:-1, 2:]
    return np.argwhere(image & ~is_inside)


def describe(image: np.ndarray, keypoints: np.ndarray, patch_size: int) -> np.ndarray:
    """Flatten the L x L patch of the occupancy image around each key point, 0 outside the image (Sec. Descriptor).

    Args:
        image: (H, W) bool.
        keypoints: (K, 2) int64, row and column.
        patch_size: L, odd.

    Returns:
        (K, L * L) bool.
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
        image: (H, W) bool, I_t.
        image1: (H, W) bool, I_{t+1}.
        reach: longest displacement in pixels, itself allowed.
        config: `patch_size`, `ratio_threshold`.

    Returns:
        The accepted matches, in raster order of their key points of t.

    Convention:
        Without a second candidate the match is accepted. Ties: smallest displacement, then smallest dy, then
        smallest dx.
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

    Args:
        at_t: key points of t.
        number: which of them.
        at_t1: key points of t+1.
        reach: longest displacement in pixels, itself allowed.

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

    Args:
        overlap, energy: c and E of the best match.
        second_overlap, second_energy: c and E of the second best.
        ratio: rho, at least 1, used to four decimals.

    Convention:
        We square c1 / sqrt(E1) > rho c2 / sqrt(E2) and clear the fractions; rho = P / 10^4. A match that is exactly
        rho times as good is rejected, and so is a tie, for every rho >= 1.
    """
    p = round(ratio * 10_000)
    return overlap * overlap * second_energy * 10_000**2 > p * p * second_overlap * second_overlap * energy
