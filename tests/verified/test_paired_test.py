"""The paired test: counts, evidence and choice equal to the oracle's."""

from __future__ import annotations

from typing import Tuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import for_oracle, from_images
from oracle import paired_test as oracle

from cflow_torch.verified import paired_test as fast

EVERY = slice(None)


class Scene:
    """Random images of B windows, S sweeps; random components; candidates on and between whole pixels."""

    def __init__(self, seed: int, num_windows: int = 2, num_steps: int = 3) -> None:
        rng = np.random.default_rng(seed)
        shape = (num_windows, num_steps, *rng.integers(3, 18, 2).tolist())
        self.images = (rng.integers(1, 16, shape) * (rng.random(shape) < 0.5)).astype(np.uint8)
        self.elapsed = np.tile(np.arange(num_steps) * rng.choice([1.0, 1.07]), (num_windows, 1))
        if num_steps > 2:  # the first window lacks the oldest sweep
            self.images[0, -1], self.elapsed[0, -1] = 0, 0.0
        self.count = 5
        component = rng.integers(0, self.count + 1, shape)  # the last: none
        own_window = component % num_windows == np.arange(num_windows)[:, None, None, None]
        self.component = np.where(own_window, component, self.count)
        self.candidates = rng.integers(-8, 9, (self.count, 4, 2)) / rng.choice([1.0, 2.0, 3.0])
        self.candidates[:, 1] = rng.normal(0, 2, (self.count, 2))
        self.candidates[0, 2], self.candidates[1, 3] = self.candidates[0, 0], 0.0
        self.tested = rng.random(self.count) < 0.8

    def found(self, windows: slice = EVERY) -> Tuple[torch.Tensor, torch.Tensor]:
        sweeps = from_images(self.images[windows], elapsed=self.elapsed[windows])
        component = torch.from_numpy(self.component[windows].ravel())[sweeps.pixel]
        return fast.count_wins(sweeps, component, *map(torch.from_numpy, (self.candidates, self.tested)))

    def expected(self) -> np.ndarray:
        counts = np.zeros((2, *self.candidates.shape[:2]), dtype=np.int64)
        sweeps = from_images(self.images, elapsed=self.elapsed)
        for window in range(len(self.images)):
            of_window = for_oracle(sweeps, window)
            for i in np.flatnonzero(self.tested).tolist():
                members = [pixel for pixel in of_window.pixels() if self.component[(window, *pixel)] == i]
                for c, motion in enumerate(self.candidates[i].tolist()):
                    counts[:, i, c] += oracle.count_wins(of_window, members, tuple(motion))
        return counts


@pytest.mark.parametrize("num_windows, num_steps", [(1, 2), (2, 3), (3, 5)])
def test_counts_equal_the_oracle(num_windows, num_steps):
    for seed in range(4):
        scene = Scene(seed, num_windows, num_steps)
        won, lost = scene.found()
        expected = scene.expected()
        assert won.dtype == lost.dtype == torch.int64
        assert [won.tolist(), lost.tolist()] == expected.tolist()
        assert expected.max() > 5


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
