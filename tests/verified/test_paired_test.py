"""The paired test: counts, evidence and choice equal to the oracle's; far motions, borders and lacking sweeps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle, from_images
from oracle import paired_test as oracle
from oracle.aperture import is_covered

from cflow_torch.verified import paired_test as fast
from cflow_torch.verified.component_tree import Nodes


def random_images(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    """Clumps of pixels that are alike in all sweeps."""
    base = (rng.integers(1, 16, shape[:1] + shape[2:]) * (rng.random(shape[:1] + shape[2:]) < 0.3)).astype(np.uint8)
    return np.where(rng.random(shape) < 0.6, base[:, None], 0).astype(np.uint8)


@pytest.mark.parametrize("at_once", [1 << 18, 700])
def test_counts_equal_the_oracle_up_to_the_border(at_once, monkeypatch):
    monkeypatch.setattr(fast, "_AT_ONCE_CPU", at_once)
    far = num_covered = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        images = random_images(rng, (2, 4, 9, 12))
        images[1, 3] = 0
        elapsed = np.array([[0, 1, 2.1, -1], [0, 1, 2, 0]])  # a sweep after t+1; a window that lacks a sweep
        sweeps = from_images(images, 0.25, elapsed)
        component = torch.from_numpy(rng.integers(0, 3, sweeps.num_pixels)) + 3 * sweeps.pixels.window
        kept = (torch.arange(sweeps.num_pixels) % 7 > 0).nonzero()[:, 0]
        candidates = torch.from_numpy(np.where(rng.random((6, 5, 1)) < 0.7, rng.normal(0, 1.5, (6, 5, 2)), 0.0))
        wins = fast.count_wins(sweeps, sweeps.pixels.take(kept), component[kept], candidates)
        component[::7] = 6
        for number in range(6):
            window = for_oracle(sweeps, number // 3)
            members = np.flatnonzero(component[sweeps.pixels.window == number // 3] == number)
            motions = candidates[number].numpy()
            for is_near, won, lost in zip((False, True), wins.won[:, number], wins.lost[:, number]):
                expected = [oracle.count_wins(window, members, each, is_near).sum(1) for each in motions]
                assert np.array_equal(torch.stack((won, lost), 1), expected)
            assert wins.in_place[number] == oracle.found_in_place(window, members, window.image)[:, 0].sum()
            assert wins.is_covered[number] == is_covered(window, members)
            num_covered += int(wins.is_covered[number])
            far += int((candidates[number].abs().amax(1) > 1.5).sum())
    assert far > 20 and 0 < num_covered < 24


def won_by_older(sweeps, motion: torch.Tensor) -> list[list[int]]:
    """Slices of the older sweep that a motion wins."""
    older = sweeps.pixels.take((sweeps.pixels.step == 1).nonzero()[:, 0])
    return fast.count_wins(sweeps, older, torch.zeros_like(older.step), motion).won[0].tolist()


def test_a_far_motion_must_leave_the_neighbourhood_as_well():
    images = np.zeros((1, 2, 5, 12), dtype=np.uint8)
    images[0, 1, 2, 2] = images[0, 0, 2, 6] = images[0, 0, 1, 3] = 1  # a pixel, where it went, one beside its old place
    sweeps = from_images(images)
    motion = torch.tensor([[[0.0, 4.0]]], dtype=torch.float64)
    assert won_by_older(sweeps, motion) == [[0]]
    images[0, 0, 1, 3] = 2  # another slice
    assert won_by_older(from_images(images), motion) == [[1]]


@pytest.mark.parametrize("z", [0.0, 1.5])
def test_evidence_equals_the_oracle(z):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(range(40), range(40))).reshape(2, -1)
    counts = np.concatenate([grid, rng.integers(0, 2**31, (2, 500))], 1)
    found = fast.evidence_of(*torch.from_numpy(counts), z)
    assert found.dtype == torch.int64
    assert found.tolist() == [oracle.evidence_of(won, lost, z) for won, lost in counts.T.tolist()]


def test_the_first_candidate_with_most_evidence_is_chosen():
    evidence = torch.tensor([[2**36 - 2, 2**36 - 1, 2**36 - 1], [1, 0, 2**36 - 1], [0, 0, 0]])
    motion, most = fast.best_candidate(evidence, torch.arange(18, dtype=torch.float64).view(3, 3, 2))
    assert motion.tolist() == [[2.0, 3.0], [10.0, 11.0], [0.0, 0.0]] and most.tolist() == [2**36 - 1] * 2 + [0]


@pytest.mark.parametrize("level, num_pixels, moves", [(0, 1, False), (0, 2, True), (2, 8, False), (2, 9, True)])
def test_nodes_of_changed_pixels_need_4_standard_deviations(level, num_pixels, moves):
    """Lone pixels that move win two slices each: 4 > 1.5 * 2 and 18 > 4 * 4.2, but 16 = 4 * 4."""
    images = np.zeros((1, 2, 40, 12), dtype=np.uint8)
    images[0, 1, 2 : 4 * num_pixels : 4, 2] = images[0, 0, 2 : 4 * num_pixels : 4, 7] = 1
    sweeps, zero = from_images(images), torch.zeros(1, dtype=torch.int64)
    every = torch.arange(sweeps.num_pixels)
    nodes = Nodes(zero, zero + level, zero + 1, zero, zero > 0, every, torch.zeros_like(every))
    motion, _ = fast.verify(sweeps, nodes, torch.tensor([[[0.0, 5.0]]], dtype=torch.float64), 2, 1.5)
    assert motion.tolist() == [[0.0, 5.0 * moves]]
