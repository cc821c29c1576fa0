"""Matching of key points: the ratio test and ties by hand, exact products."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import config

from cflow_torch.keypoints import match_candidates, matching
from cflow_torch.keypoints.descriptors import KeyPoints, describe
from cflow_torch.keypoints.matching import match

# ---------------------------------------------------------------------------------------------------------- by hand


def hand_made(pixels: list[list[int]], ones: list[int]) -> KeyPoints:
    """Key points whose 11 x 11 descriptors have their first pixels set."""
    row, col = torch.tensor(pixels, dtype=torch.int64).reshape(-1, 2).unbind(1)
    patch = torch.tensor([[1] * n + [0] * (121 - n) for n in ones], dtype=torch.uint8).reshape(-1, 121)
    return KeyPoints(row * 40_000 + col, torch.zeros_like(row), row, col, patch, patch.sum(1))


def shifts(pc0: KeyPoints, pc1: KeyPoints, reach: float = 10.0, ratio: float = 1.1) -> dict[int, tuple[int, int]]:
    settings = config("keypoints", patch_size=11, ratio_threshold=ratio)
    found = match(pc0, pc1, torch.tensor([reach], dtype=torch.float64), settings)
    return dict(zip(found.source.tolist(), map(tuple, found.shift.tolist())))


def test_the_ratio_test_is_strict_and_exact():
    # R^2 = c^2 / (E E'): the best coincides fully with the 121 ones, the second in 100: R = 1, R' = 10 / 11.
    pc0, pc1 = hand_made([[5, 5]], [121]), hand_made([[5, 6], [5, 9]], [121, 100])
    assert shifts(pc0, pc1, ratio=1.0999) == {0: (0, 1)}
    assert shifts(pc0, pc1, ratio=1.1) == {}  # R = rho R' does not pass; 1.1 * 1.1 is not 1.21 in floats
    assert shifts(pc0, pc1, ratio=1.10004) == shifts(pc0, pc1, ratio=1.09996) == {}  # rho is used to four decimals
    # Second best 1 / 1.2^2 = 25 / 36 of the energy: 36 against 25 ones.
    pc0, pc1 = hand_made([[5, 5]], [36]), hand_made([[5, 6], [5, 9]], [36, 25])
    assert shifts(pc0, pc1, ratio=1.2) == {} and shifts(pc0, pc1, ratio=1.1999) == {0: (0, 1)}


def test_a_single_candidate_is_accepted_and_a_tie_is_rejected():
    assert shifts(hand_made([[5, 5]], [9]), hand_made([[4, 3]], [1]), ratio=2.0) == {0: (-1, -2)}
    assert shifts(hand_made([[5, 5]], [9]), hand_made([[4, 3], [9, 9]], [9, 9]), ratio=1.0) == {}


def test_a_match_at_the_radius_is_allowed():
    for corner in (50, 32_700):  # near the corner of the image and far from it
        pc0 = hand_made([[corner, corner]], [9])
        for (dy, dx), reach, inside in (((3, 4), 5.0, True), ((3, 4), 4.999, False), ((0, 0), 0.5, True)):
            assert bool(shifts(pc0, hand_made([[corner + dy, corner + dx]], [9]), reach)) == inside
    assert shifts(hand_made([[0, 0]], [9]), hand_made([[32_700, 32_700]], [9]), 1e9) == {0: (32_700, 32_700)}


def test_without_key_points_there_are_no_matches():
    none, one = hand_made([], []), hand_made([[5, 5]], [9])
    assert all(shifts(*pair) == {} for pair in ((none, one), (one, none), (none, none)))


# ---------------------------------------------------------------------------------------------- parts of the search


def test_all_within_the_radius_are_candidates():
    rng = np.random.default_rng(4)
    images = torch.from_numpy(rng.random((2, 50, 90)) < 0.05)
    pc0, pc1 = describe(images, 3), describe(images.flip(2), 3)
    reach = torch.tensor([4.5, 30.0], dtype=torch.float64)
    pairing = match_candidates.pair(pc0, pc1, reach)
    found = set()
    for member, first, count in zip(pairing.member.tolist(), pairing.first.tolist(), pairing.count.tolist()):
        found |= {(p, q) for p in member for q in pairing.candidate[first : first + count].tolist()}
    for p in range(len(pc0.row)):
        square = (pc1.row - pc0.row[p]) ** 2 + (pc1.col - pc0.col[p]) ** 2
        near = (pc1.window == pc0.window[p]) & (square <= reach[pc0.window[p]] ** 2)
        assert {(p, q) for q in near.nonzero()[:, 0].tolist()} <= found
    assert len(found) < 0.8 * len(pc0.row) * len(pc1.row)


@pytest.mark.parametrize("precision", ["highest", "medium"])
@pytest.mark.parametrize("patch_size", [1, 11, 51])
def test_the_products_count_exactly(patch_size, precision):
    generator, descriptors = torch.Generator().manual_seed(patch_size), []
    for number, density in ((7, 0.1), (9, 0.7)):
        patch = torch.rand((number, patch_size**2), generator=generator) < density
        patch[0], patch[1] = True, False
        descriptors.append(patch.byte())
    expected = (descriptors[0][:, None] & descriptors[1]).sum(2)
    strips0, strips1 = matching._pack(descriptors[0], False), matching._pack(descriptors[1], True)
    before = torch.get_float32_matmul_precision()
    try:
        torch.set_float32_matmul_precision(precision)
        found = matching._overlap(strips0, torch.arange(8).view(2, 4), strips1, torch.arange(10).repeat(2))
    finally:
        torch.set_float32_matmul_precision(before)
    found = found.reshape(8, 10) >> 7
    assert torch.equal(found[:7, :9], expected.int()) and not found[7].any() and not found[:, 9].any()  # padding


def test_values_that_float32_cannot_separate_are_both_contenders():
    # float32 rounds two close values of count^2 / energy to one number. The margin keeps the next smaller one, too.
    share = 1 - matching._ROUNDING
    for count, energy in ((2601, 2601), (2600, 2599), (51, 2601), (1, 2601)):
        value = torch.tensor(float(count * count)) / energy
        below = torch.nextafter(value, torch.tensor(0.0))
        assert below >= value * share and value.double() * (1 - 2**-22) >= (value * share).double()
