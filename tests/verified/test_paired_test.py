"""The paired test: counts, evidence and choice equal to the oracle's; far motions, borders and lacking sweeps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import for_oracle, from_images
from oracle import paired_test as oracle

from cflow_torch.verified import paired_test as fast


def random_images(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    """Clumps of pixels that are alike in all sweeps."""
    base = (rng.integers(1, 16, shape[:1] + shape[2:]) * (rng.random(shape[:1] + shape[2:]) < 0.3)).astype(np.uint8)
    return np.where(rng.random(shape) < 0.6, base[:, None], 0).astype(np.uint8)


@pytest.mark.parametrize("at_once", [1 << 18, 700])
def test_counts_equal_the_oracle_up_to_the_border(at_once, monkeypatch):
    monkeypatch.setattr(fast, "_AT_ONCE_CPU", at_once)
    far = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        images = random_images(rng, (2, 4, 9, 12))
        images[1, 3] = 0
        elapsed = np.array([[0, 1, 2.1, -1], [0, 1, 2, 0]])  # a sweep after t+1; a window that lacks a sweep
        sweeps = from_images(images, 0.25, elapsed)
        owner = torch.from_numpy(rng.integers(0, 3, sweeps.num_pixels)) + 3 * sweeps.pixels.window
        owner[::7] = 6
        candidates = torch.from_numpy(np.where(rng.random((6, 5, 1)) < 0.7, rng.normal(0, 1.5, (6, 5, 2)), 0.0))
        tested = torch.tensor([True, True, False, True, True, True])
        wins = fast.count_wins(sweeps, sweeps.pixels, owner, candidates, tested)
        for number in range(6):
            window = for_oracle(sweeps, number // 3)
            owners = owner[sweeps.pixels.window == number // 3].tolist()
            members = [pixel for pixel, own in zip(window.pixels(), owners) if own == number]
            expected = [oracle.count_wins(window, members, (y, x)) for y, x in candidates[number].tolist()]
            if number == 2:
                assert not wins.won[2].any() and not wins.lost[2].any() and wins.in_place[2] == 0
                continue
            assert list(zip(wins.won[number].tolist(), wins.lost[number].tolist())) == expected
            assert wins.in_place[number] == oracle.count_in_place(window, members)
            far += int((candidates[number].abs().amax(1) > 1.5).sum())
    assert far > 20


def test_a_far_motion_must_leave_the_neighbourhood_as_well():
    images = np.zeros((1, 2, 5, 12), dtype=np.uint8)
    images[0, 1, 2, 2] = images[0, 0, 2, 6] = images[0, 0, 1, 3] = 1  # a pixel, where it went, one beside its old place
    sweeps = from_images(images)
    owner = torch.where(sweeps.pixels.step == 1, 0, 1)
    motion = torch.tensor([[[0.0, 4.0]]], dtype=torch.float64)
    assert fast.count_wins(sweeps, sweeps.pixels, owner, motion, torch.tensor([True])).won.tolist() == [[0]]
    images[0, 0, 1, 3] = 2  # another slice
    sweeps = from_images(images)
    assert fast.count_wins(sweeps, sweeps.pixels, owner, motion, torch.tensor([True])).won.tolist() == [[1]]


@pytest.mark.parametrize("z", [0.0, 1.5])
def test_evidence_equals_the_oracle(z):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(range(40), range(40))).reshape(2, -1)
    counts = np.concatenate([grid, rng.integers(0, 2**31, (2, 500))], 1)
    found = fast.evidence_of(*torch.from_numpy(counts), z)
    assert found.dtype == torch.int64
    assert found.tolist() == [oracle.evidence_of(won, lost, z) for won, lost in counts.T.tolist()]


@settings(deadline=None, max_examples=40, derandomize=True)
@given(st.integers(1, 6).flatmap(lambda c: st.lists(st.lists(st.integers(0, 3), min_size=c, max_size=c), min_size=1)))
def test_choice_equals_the_oracle(evidence):
    candidates = np.random.default_rng(1).normal(size=(len(evidence), len(evidence[0]), 2))
    motion, most = fast.best_candidate(torch.tensor(evidence), torch.from_numpy(candidates))
    expected = [oracle.best_candidate(row, [tuple(f) for f in fs]) for row, fs in zip(evidence, candidates.tolist())]
    assert [(tuple(f), e) for f, e in zip(motion.tolist(), most.tolist())] == expected


def test_much_evidence_is_told_apart():
    evidence = torch.tensor([[2**36 - 2, 2**36 - 1, 2**36 - 1], [1, 0, 2**36 - 1]])
    motion, most = fast.best_candidate(evidence, torch.arange(12, dtype=torch.float64).view(2, 3, 2))
    assert motion.tolist() == [[2.0, 3.0], [10.0, 11.0]] and most.tolist() == [2**36 - 1] * 2
