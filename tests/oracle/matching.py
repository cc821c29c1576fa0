"""Matches between the key points of two images (Sec. CorrelationFlow-Keypoints: Matching keypoints).

Pixels are (row, column), displacements are pixels, t -> t+1.
"""

from __future__ import annotations

import math
from typing import List, NamedTuple

import numpy as np

from cflow_torch.config import Config
from oracle.descriptors import Keypoints, described_keypoints


class Candidate(NamedTuple):
    """A key point of t+1 as a match of one of t, or the reverse; the smaller tuple is the better match.

    Attributes:
        minus_rank: -c^2 / E of the other one's descriptor.
        squared_length, dy, dx: displacement t -> t+1 in pixels, whichever of the two looks for the other.
        number: the other one's number.
        overlap: c, number of positions at which both descriptors are one.
    """

    minus_rank: float
    squared_length: int
    dy: int
    dx: int
    number: int
    overlap: int


class Match(NamedTuple):
    """An accepted match: pixel of the key point of t, displacement to t+1 in pixels, Eq. descriptor_ncc."""

    row: int
    column: int
    dx: int
    dy: int
    score: float


def match_keypoints(image: np.ndarray, image1: np.ndarray, reach: float, config: Config) -> List[Match]:
    """Sec. Matching keypoints: Eq. best_match of every key point of t, then the ratio test.

    Args:
        image: (H, W) bool, I_t.
        image1: (H, W) bool, I_{t+1}.
        reach: longest displacement in pixels, itself allowed.
        config: `patch_size`, `ratio_threshold`, `second_best_distance`, `mutual_check`.

    Returns:
        The accepted matches, in raster order of their key points of t.

    Convention:
        The second best lies at least `second_best_distance` pixels from the best; where there is none the match is
        accepted. `mutual_check` (not in the paper) asks besides that the key point of t is the best one of its
        match. Ties in either direction: smallest displacement t -> t+1, then smallest dy, then smallest dx.
    """
    at_t, at_t1 = (described_keypoints(i, config.patch_size) for i in (image, image1))
    matches = []
    for i, (row, column) in enumerate(at_t.pixels.tolist()):
        candidates = rank_candidates(at_t, i, at_t1, reach, forward=True)
        if not candidates:
            continue
        best = candidates[0]
        energy, energy1 = int(at_t.energies[i]), int(at_t1.energies[best.number])
        second = next((c for c in candidates[1:] if lies_apart(c, best, config.second_best_distance)), None)
        if second is not None:
            second_energy = int(at_t1.energies[second.number])
            if not passes_ratio_test(best.overlap, energy1, second.overlap, second_energy, config.ratio_threshold):
                continue
        if config.mutual_check and rank_candidates(at_t1, best.number, at_t, reach, forward=False)[0].number != i:
            continue
        score = best.overlap / math.sqrt(energy * energy1)
        matches.append(Match(row, column, best.dx, best.dy, score))
    return matches


def rank_candidates(viewers: Keypoints, viewer: int, others: Keypoints, reach: float, forward: bool) -> List[Candidate]:
    """Key points of the other image within the gate of one key point, the best match first (Eq. best_match).

    Args:
        viewers: key points of the image that looks for matches.
        viewer: number of the one that looks.
        others: key points of the other image.
        reach: longest displacement in pixels, itself allowed.
        forward: True where the viewer belongs to t, False where it belongs to t+1.

    Convention:
        Eq. descriptor_ncc is c / sqrt(E E_other); E is the viewer's own, so c^2 / E_other ranks its candidates. The
        float64 quotient ranks as the exact rational does: counts are at most 51^2 = 2601, so equal rationals are
        rounded alike, and different ones differ by at least 1 / 2601^2 > 1e-7, at values of at most 2601, where
        rounding changes less than 1e-12.
    """
    r, c = viewers.pixels[viewer].tolist()
    # A square that holds the gate for certain; the comparison below decides.
    half = int(min(reach, max(others.number_at.shape))) + 1
    square = others.number_at[max(r - half, 0) : r + half + 1, max(c - half, 0) : c + half + 1]
    numbers = square[square >= 0]
    dy, dx = (others.pixels[numbers] - viewers.pixels[viewer]).T
    near = dx * dx + dy * dy <= reach * reach
    numbers, dy, dx = numbers[near], dy[near], dx[near]
    if not forward:
        dy, dx = -dy, -dx

    overlap = np.count_nonzero(others.descriptors[numbers] & viewers.descriptors[viewer], axis=1)
    rank = overlap * overlap / others.energies[numbers]
    columns = (-rank, dx * dx + dy * dy, dy, dx, numbers, overlap)
    return sorted(map(Candidate._make, zip(*(column.tolist() for column in columns))))


def lies_apart(candidate: Candidate, best: Candidate, distance: float) -> bool:
    """Whether two key points, seen from the same one, are at least `distance` pixels apart."""
    dy, dx = candidate.dy - best.dy, candidate.dx - best.dx
    return dx * dx + dy * dy >= distance * distance


def passes_ratio_test(overlap: int, energy: int, second_overlap: int, second_energy: int, ratio: float) -> bool:
    """R_best > rho R_second (Sec. Matching keypoints), in whole numbers.

    Args:
        overlap: c of the best match.
        energy: E of the best match's descriptor.
        second_overlap: c of the second best.
        second_energy: E of the second best's descriptor.
        ratio: rho, at least 1, used to four decimals.

    Convention:
        Both sides of c1 / sqrt(E1) > rho c2 / sqrt(E2) are squared and freed of fractions; rho = P / 10^4. Exactly
        rho times as good is not enough, so where the two rank the same there is no match, whatever rho >= 1.
    """
    p = round(ratio * 10_000)
    return overlap * overlap * second_energy * 10_000**2 > p * p * second_overlap * second_overlap * energy
