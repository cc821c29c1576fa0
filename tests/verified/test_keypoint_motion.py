"""Key points as candidates of the proof: equal to the loops, the same bits however windows come, what they are for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracle import keypoint_motion as ref
from oracle import reference_flow
from oracle.sweeps import Cloud
from scenes import assert_same, config, needs_gpu
from scenes import scene as scene_of_boxes

from cflow_torch import CFlowError, Config, CorrelationFlow, Sweep, Window
from cflow_torch.verified.height_slices import make_cells
from cflow_torch.verified.keypoint_motion import KeyPointMotion, match_key_points
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch

KEY_POINTS = {"patch_size": 9, "ratio_threshold": 1.02, "gate_radius": 1.5}


def settings(seed: int, **overrides) -> Config:
    return config(
        **{
            "pixel_sizes": ((0.25,), (0.5, 0.25))[seed % 2],
            "height_slices": seed % 2 * 4,
            "proof": True,
            "proof_z": (0.0, 1.0)[seed % 2],
            "children": seed % 3 > 0,
            "keypoint_block": (1, 2, 3)[seed % 3],
            **KEY_POINTS,
            **overrides,
        }
    )


def listed(window: Window, settings: Config):
    """Cells of a window and the matches in them."""
    box = settings.point_cloud_range
    grid = Grid(settings.pixel_sizes[-1], box[:3], box[3:])
    batch = make_batch([window], settings, grid)
    cells, _ = make_cells(batch, grid, settings.slice_height)
    return cells, match_key_points(cells, batch, settings.keypoint_block, settings)


@pytest.mark.parametrize("seed", range(6))
def test_matches_equal_the_loop(seed):
    chosen, window = settings(seed), scene_of_boxes(40 + seed)
    cells, found = listed(window, chosen)
    images = cells.image[:-1].view(2, cells.grid.height, cells.grid.width).numpy()
    nothing = np.zeros((0, 3))
    cloud = Cloud(nothing, np.zeros(0, dtype=bool), steps=1.0, elapsed=0.1)
    shifts = ref.keypoint_shifts(images, cloud, chosen.keypoint_block, chosen)
    expected = np.argwhere(~np.isnan(shifts[..., 0]) & (images[1] > 0))
    assert len(expected) > 10
    assert cells.step[found.pixel].eq(1).all()
    assert torch.stack((cells.row, cells.col), 1)[found.pixel].tolist() == expected.tolist()
    assert found.motion.tolist() == shifts[tuple(expected.T)].tolist()


@pytest.mark.parametrize("seed", range(3))
def test_medians_equal_the_loop(seed):
    rng = np.random.default_rng(seed)
    node, num_nodes = rng.integers(0, 8, 60), 7
    node[node == 4] = num_nodes  # a component without a match
    pixel, shifts = np.sort(rng.permutation(60)[:35]), rng.integers(-3, 4, (35, 2)).astype(np.float64)
    found = KeyPointMotion(torch.from_numpy(pixel), torch.from_numpy(shifts)).of_components(
        torch.from_numpy(node), num_nodes
    )
    dense = np.full((60, 1, 2), np.nan)
    dense[pixel, 0] = shifts
    expected = [ref.keypoint_motion((node == i)[:, None], dense) for i in range(num_nodes)]
    assert found.tolist() == [list(motion) for motion in expected]
    assert expected[4] == (0.0, 0.0)


def test_without_any_match():
    nobody = torch.zeros(0, dtype=torch.int64)
    none = KeyPointMotion(nobody, torch.zeros((0, 2), dtype=torch.float64))
    assert none.of_components(torch.tensor([0, 1, 2]), 2).tolist() == [[0.0, 0.0]] * 2
    empty = Sweep(np.zeros((0, 3), np.float32))
    (result,) = CorrelationFlow(settings(0))([Window(empty, empty)])
    assert result.residual_flow.shape == (0, 3)


@pytest.mark.parametrize("seed", range(8))
def test_the_whole_equals_the_reference(seed):
    chosen = settings(seed, num_history=seed % 3, use_timestamps=seed % 2 > 0, max_speed=(None, 6.0)[seed % 4 == 0])
    window = scene_of_boxes(300 + seed, num_history=seed % 3, poses=seed % 2 > 0, stamps=True)
    (result,) = CorrelationFlow(chosen)([window])
    assert_same(result, reference_flow(window, chosen))


def test_alone_or_in_a_batch():
    windows = [scene_of_boxes(60 + seed, num_history=seed % 3) for seed in range(5)]
    flow = CorrelationFlow(settings(1, num_history=2))
    for window, together in zip(windows, flow(windows)):
        assert_same(flow([window])[0], together)


def test_they_find_what_moves_farther_than_it_is_long():
    # The correlation searches half of the box of both sweeps together: 3 of the 4 pixels.
    rng = np.random.default_rng(0)
    post = rng.uniform((-0.37, -0.37, -1.0), (0.37, 0.37, 1.0), (150, 3)) + (0.125, 0.125, 0.0)
    window = Window(Sweep(post - (1.0, 0.0, 0.0)), Sweep(post))
    for keypoint_block, expected in ((0, 0.75), (1, 1.0)):
        chosen = settings(0, keypoint_block=keypoint_block)
        (result,) = CorrelationFlow(chosen)([window])
        assert_same(result, reference_flow(window, chosen))
        assert result.residual_flow[:, 0].median() == expected


def test_off_they_change_nothing_and_on_they_propose():
    plain, moved = settings(1, keypoint_block=0), []
    for seed in range(12):
        window = scene_of_boxes(500 + seed)
        (result,) = CorrelationFlow(plain)([window])
        assert_same(result, CorrelationFlow(plain.replace(patch_size=21))([window])[0])
        (other,) = CorrelationFlow(settings(1))([window])
        moved.append(not torch.equal(result.residual_flow, other.residual_flow))
    assert any(moved) and not all(moved)


@pytest.mark.parametrize("wrong", [-1, 0.3, None, True, 10**7])
def test_sizes_that_make_no_sense(wrong):
    with pytest.raises(CFlowError, match="keypoint_block"):
        settings(0, keypoint_block=wrong)


def test_without_the_proof_they_are_not_asked():
    window, plain = scene_of_boxes(500), settings(1, proof=False, keypoint_block=0)
    (expected,) = CorrelationFlow(plain)([window])
    assert_same(CorrelationFlow(plain.replace(keypoint_block=2))([window])[0], expected)


@pytest.mark.cuda
@needs_gpu
def test_cuda_equals_cpu():
    windows = [scene_of_boxes(60 + seed, num_history=seed % 3) for seed in range(5)]
    chosen = settings(1, num_history=2)
    on_cpu, on_gpu = (CorrelationFlow(chosen, device=device)(windows) for device in ("cpu", "cuda"))
    for cpu, gpu in zip(on_cpu, on_gpu):
        assert_same(cpu, gpu)
