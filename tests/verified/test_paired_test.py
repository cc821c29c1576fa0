"""The paired test: evidence and choice equal to the oracle's."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from oracle import paired_test as oracle

from cflow_torch.verified import paired_test as fast


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
