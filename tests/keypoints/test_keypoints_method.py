"""The key-point method equals the oracle, finds known motions, and matches by an exact ratio test."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.keypoints import match_radius
from scenes import config, flow_as_oracle, needs_kornia_labelling, scene

from cflow_torch import Sweep, Window, make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window as window_of
from cflow_torch.keypoints import matching
from cflow_torch.keypoints.match_candidates import KeyPoints, Patches
from cflow_torch.keypoints.matching import match_keypoints

DENSIFIERS = ("components", "clusters", "nearest")


@pytest.mark.parametrize("seed", range(18))
def test_equals_the_oracle_on_random_scenes(seed):
    settings = config(
        "keypoints",
        densify=DENSIFIERS[seed % 3],
        patch_size=(1, 5, 11, 13)[seed % 4],
        ratio_threshold=(1.0, 1.02, 1.3)[seed % 5 % 3],
        gate_radius=(0.6, 2.0)[seed % 2],
        max_speed=(None, 4.0)[seed % 6 == 1],  # less than the gate
        pixel_sizes=((0.25,), (0.5, 0.25))[seed % 7 > 4],
        connectivity=(4, 8)[seed % 5 > 1],
        ego_box=(None, (-3.0, -2.0, 2.5, 3.0))[seed % 6 == 5],
    )
    flow_as_oracle(scene(30 + seed, poses=seed % 4 > 0, stamps=seed % 3 > 0), settings)


@pytest.mark.parametrize("densify", ["components", "clusters"])
@needs_kornia_labelling
def test_kornia_equals_the_oracle(densify):
    flow_as_oracle(scene(2), config("keypoints", densify=densify, labeling="kornia", connectivity=4))


def test_real_drives_equal_the_oracle(av2_folder, kitti_file):
    near = (-15.0, -8.0, -math.inf, 0.0, 3.0, math.inf)
    with HDF5Log(kitti_file) as log:
        windows = [window_of(AV2Log(av2_folder), 0), window_of(log, 9, 0)]
    for window, densify in zip(windows, ("clusters", "nearest")):
        result = flow_as_oracle(window, make_config("keypoints", point_cloud_range=near, densify=densify))
        assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 500  # there is something to find


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["keypoints", "paper_keypoints"])
def test_the_whole_real_pair_equals_the_oracle(av2_folder, preset):
    flow_as_oracle(window_of(AV2Log(av2_folder), 0), make_config(preset))


METRE = config(
    "keypoints", pixel_size=1.0, point_cloud_range=(0.0, 0.0, -math.inf, 40.0, 40.0, math.inf), max_extent=1000.0
)
# (row, column) pixels of an L, 6 high and 5 wide.
ELL = [(r, 10) for r in range(10, 16)] + [(15, c) for c in range(11, 15)]


def sweep(pixels, move=(0.0, 0.0, 0.0), **fields) -> Sweep:
    """A point in the middle of each 1 m pixel."""
    return Sweep(np.array([(c + 0.5, r + 0.5, 0.5) for r, c in pixels]).reshape(-1, 3) + np.array(move), **fields)


def test_an_ell_is_matched_and_components_without_a_match_keep_their_ids():
    window, n = Window(sweep([*ELL, (2, 30), (30, 5)]), sweep(ELL, (2, 1, 0))), len(ELL)
    result = flow_as_oracle(window, METRE.replace(gate_radius=4.0))
    assert result.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * n + [[0.0, 0.0, 0.0]] * 2
    assert result.cluster_id.tolist() == [1] * n + [0, 2]  # raster order of I_t, with or without a match
    assert result.score.tolist() == [1.0] * n + [0.0, 0.0] and result.is_valid.all()
    nearest = flow_as_oracle(window, METRE.replace(gate_radius=4.0, densify="nearest"))
    assert nearest.residual_flow.tolist() == [[2.0, 1.0, 0.0]] * (n + 2) and (nearest.score == 1).all()
    small = Window(*(Sweep(s.points * 0.25) for s in (window.pc0, window.pc1)))
    scaled = flow_as_oracle(small, METRE.replace(gate_radius=1.0, pixel_sizes=(0.25,)))
    assert torch.equal(scaled.residual_flow, result.residual_flow * 0.25)


def test_opposite_matches_have_a_median_of_zero():
    # Two pixels of one component, matched one to the left and one to the right.
    window = Window(sweep([(5, 5), (5, 6)]), sweep([(5, 4), (5, 7)]))
    result = flow_as_oracle(window, METRE.replace(patch_size=1, gate_radius=1.0))
    assert result.score.tolist() == [1.0, 1.0]
    assert not result.residual_flow.any() and not torch.signbit(result.residual_flow).any()


def test_densify_clusters_dilates_and_components_does_not():
    # Two pixels apart: one cluster after the dilation, two components without.
    window = Window(sweep([(5, 5), (5, 7), (5, 12)]), sweep([(6, 5), (6, 12)]))
    together = METRE.replace(patch_size=1, gate_radius=1.0, densify="clusters")
    result = flow_as_oracle(window, together)
    assert result.cluster_id.tolist() == [0, 0, 1] and result.residual_flow.tolist() == [[0.0, 1.0, 0.0]] * 3
    apart = flow_as_oracle(window, together.replace(densify="components"))
    assert apart.cluster_id.tolist() == [0, 1, 2] and apart.score.tolist() == [1.0, 0.0, 1.0]


def test_the_radius_of_matches_follows_time_and_speed():
    assert match_radius(METRE.replace(gate_radius=3.0), 0.1, 0.5) == 6.0
    assert match_radius(METRE.replace(gate_radius=3.0), 0.05, 0.5) == 3.0  # metres per 0.1 s
    assert match_radius(METRE.replace(gate_radius=3.0, max_speed=20.0), 0.1, 0.5) == 5.0  # 2 m and one pixel
    # 3 m in a step; the time stamps say 0.05 s.
    for stamps, expected in [((0, 100_000_000), 3.0), ((0, 50_000_000), 0.0), ((None, 50_000_000), 3.0)]:
        window = Window(sweep([(5, 5)], timestamp_ns=stamps[0]), sweep([(5, 8)], timestamp_ns=stamps[1]))
        assert flow_as_oracle(window, METRE.replace(gate_radius=3.0)).residual_flow[0, 0] == expected


def hand_made(pixels: list[list[int]], ones: list[int]) -> KeyPoints:
    """Key points whose 11 x 11 descriptors have their first pixels set."""
    row, col = torch.tensor(pixels, dtype=torch.int64).reshape(-1, 2).unbind(1)
    patch = torch.tensor([[1] * n + [0] * (121 - n) for n in ones], dtype=torch.uint8).reshape(-1, 121)
    return KeyPoints(row * 40_000 + col, torch.zeros_like(row), row, col, patches_of(patch), patch.sum(1))


def patches_of(patch: torch.Tensor) -> Patches:
    """Descriptors from all their pixels, (K, L^2) uint8."""
    size = math.isqrt(patch.shape[1])
    return Patches(patch.flatten(), torch.arange(0, patch.numel(), size).view(-1, size))


def shifts(pc0: KeyPoints, pc1: KeyPoints, reach: float = 10.0, ratio: float = 1.1) -> dict[int, tuple[int, int]]:
    settings = config("keypoints", patch_size=11, ratio_threshold=ratio)
    found = match_keypoints(pc0, pc1, torch.tensor([reach], dtype=torch.float64), settings)
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


@pytest.mark.parametrize("precision", ["highest", "medium"])
@pytest.mark.parametrize("patch_size", [1, 11, 51])
def test_shared_pixels_are_counted_exactly(patch_size, precision):
    generator, points, patches = torch.Generator().manual_seed(patch_size), [], []
    for number, density in ((7, 0.1), (150, 0.7)):
        patch = torch.rand((number, patch_size**2), generator=generator) < density
        patch[0], patch[:, 0] = True, True  # every descriptor has a set pixel
        index = torch.arange(number)
        zero = torch.zeros_like(index)
        patches.append(patch)
        points.append(KeyPoints(index, zero, zero, index, patches_of(patch.byte()), patch.sum(1)))
    pc0, pc1 = points
    expected = (patches[0][:, None] & patches[1]).sum(2)
    targets = matching.arrange_targets(pc1)
    reach = torch.tensor([1000.0], dtype=torch.float64)
    before = torch.get_float32_matmul_precision()
    counted = torch.zeros(7, dtype=torch.int64)
    try:
        torch.set_float32_matmul_precision(precision)
        for bags in matching.make_bags(pc0, targets.blocks, reach, config("keypoints", max_memory=60_000)):
            source = bags.source[bags.of_source.of_item][:, None].expand(-1, 64)
            number = targets.number[bags.block]
            is_target = targets.energy[bags.block].isfinite()
            count = matching.shared_pixels(pc0, bags, targets)
            assert torch.equal(count[is_target].long(), expected[source[is_target], number[is_target]])
            counted.index_add_(0, source[is_target], torch.ones_like(source[is_target]))
    finally:
        torch.set_float32_matmul_precision(before)
    assert counted.tolist() == [150] * 7  # every pair once


def test_values_that_float32_cannot_separate_are_both_contenders():
    # float32 rounds two close values of count^2 / energy to one number. The margin keeps the next smaller one, too.
    share = 1 - matching._ROUNDING
    for count, energy in ((2601, 2601), (2600, 2599), (51, 2601), (1, 2601)):
        value = torch.tensor(float(count * count)) / energy
        below = torch.nextafter(value, torch.tensor(0.0))
        assert below >= value * share and value.double() * (1 - 2**-22) >= (value * share).double()
