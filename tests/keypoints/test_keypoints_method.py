"""The key-point method equals the oracle on random scenes and real drives, and finds known motions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.keypoints import match_radius
from scenes import assert_same, box, config, flow_as_oracle, needs_gpu, needs_kornia_labelling, scene

from cflow_torch import CorrelationFlowKeypoints, Sweep, Window, estimate_flow, make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window as window_of

DENSIFIERS = ("components", "clusters", "nearest")


@pytest.mark.parametrize("seed", range(18))
def test_equals_the_oracle_on_random_scenes(seed):
    settings = config(
        "keypoints",
        densify=DENSIFIERS[seed % 3],
        patch_size=(1, 5, 11, 13)[seed % 4],
        ratio_threshold=(1.0, 1.02, 1.3)[seed % 5 % 3],
        gate_radius=(0.6, 2.0)[seed % 2],
        max_speed=(None, 4.0)[seed % 6 == 0],
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
@pytest.mark.parametrize("preset", ["keypoints", "paper"])
def test_the_whole_real_pair_equals_the_oracle(av2_folder, preset):
    flow_as_oracle(window_of(AV2Log(av2_folder), 0), make_config(preset, method="keypoints"))


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("densify", DENSIFIERS)
def test_cuda_equals_cpu(densify):
    settings, windows = config("keypoints", densify=densify), [scene(seed) for seed in range(6)]
    on_gpu, on_cpu = (CorrelationFlowKeypoints(settings, device)(windows) for device in ("cuda", "cpu"))
    for one, other in zip(on_gpu, on_cpu):
        assert_same(one, other, atol=1e-4)


# ------------------------------------------------------------------------------------------------- known motions

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


def test_whole_pixel_shifts_of_boxes_are_found():
    rng = np.random.default_rng(3)
    boxes = [box(rng, 3.0, 1.5, 1.5, 4000) + position for position in ([-5.0, -4.0, 0], [1.0, 3.0, 0], [4.0, -3.0, 0])]
    shifts = ([0.5, 0.25, 0], [-0.75, 0, 0], [0, 0, 0])
    moved = [points + shift for points, shift in zip(boxes, shifts)]
    result = estimate_flow(
        np.concatenate(boxes), np.concatenate(moved), method="keypoints", preset="paper", pixel_size=0.25
    )
    assert np.array_equal(result.residual_flow.numpy(), np.repeat(shifts, 4000, axis=0).astype(np.float32))
    assert result.cluster_id.unique().tolist() == [0, 1, 2]
