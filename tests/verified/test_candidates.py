"""Candidates: equal to the scalar rule to the bit; sweeps that are missing change no choice; nested components."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle import candidates as ref
from scenes import needs_gpu, same_bits

from cflow_torch.verified.candidates import inherit, make_candidates
from cflow_torch.verified.paired_test import choose


def estimates(seed: int, num_nodes: int = 300, num_sweeps: int = 5):
    """Whole and parabola's pixels by whole and uneven steps: zeros, ties and opposites abound."""
    rng = np.random.default_rng(seed)
    whole = rng.integers(-3, 4, (num_nodes, num_sweeps, 2)) * (rng.random((num_nodes, num_sweeps, 1)) < 0.8)
    free = whole + rng.uniform(-0.5, 0.5, whole.shape)
    given = np.where(rng.random((num_nodes, 1, 1)) < 0.6, whole, free).astype(np.float64)
    available = rng.random((num_nodes, num_sweeps)) < 0.7
    intervals = np.where(rng.random((num_nodes, 1)) < 0.7, 1.0, 1.0625) * np.arange(1, num_sweeps + 1)
    inherited = np.round(rng.normal(0, 2, (num_nodes, 2))) / 2 + 0.0
    given[~available] = math.nan  # must not be looked at
    intervals[~available] = 0.0
    return given, available, intervals, inherited


def scalar(given, available, intervals, inherited):
    for f, known, k, parent in zip(given, available, intervals, inherited):
        row = [tuple(v) if is_known else None for v, is_known in zip(f.tolist(), known.tolist())]
        yield ref.candidates(row, k.tolist(), [tuple(parent.tolist())])


def candidates_of(given, available, intervals, inherited):
    return make_candidates(given, available, intervals, [inherited])


@pytest.mark.parametrize("num_sweeps", [1, 2, 3, 5])
def test_candidates_equal_the_scalar_rule(num_sweeps):
    for seed in range(3):
        given = estimates(seed, num_sweeps=num_sweeps)
        found = candidates_of(*map(torch.from_numpy, given))
        expected = np.array(list(scalar(*given))) + 0.0  # no -0.0
        assert found.shape == expected.shape == (300, num_sweeps + 1 + (num_sweeps > 1), 2)
        assert found.numpy().tobytes() == expected.tobytes()


def test_without_a_coarser_level():
    given, available, intervals, inherited = map(torch.from_numpy, estimates(1))
    found = make_candidates(given, available, intervals)
    assert same_bits(found, candidates_of(given, available, intervals, inherited)[:, :-1].contiguous())
    assert found.shape == (300, 6, 2)


def test_no_negative_zero():
    for seed in range(3):
        found = candidates_of(*map(torch.from_numpy, estimates(seed)))
        assert not (torch.signbit(found) & (found == 0)).any()
    minus = torch.tensor([[[-0.0, -0.0]]], dtype=torch.float64)
    one = torch.ones((1, 1), dtype=torch.float64)
    assert not torch.signbit(candidates_of(minus, one.bool(), one, minus[0])).any()


def test_sweeps_that_a_window_lacks_change_no_choice():
    # A window of two sweeps, alone and in a batch with windows of six. What a motion is worth depends on it alone.
    given, available, intervals, inherited = map(torch.from_numpy, estimates(4, num_sweeps=1))
    alone = candidates_of(given, available, intervals, inherited)
    padded = [torch.cat((v, v.new_zeros((300, 4, *v.shape[2:]))), 1) for v in (given, available, intervals)]
    together = candidates_of(*padded, inherited)

    def worth(motions: torch.Tensor) -> torch.Tensor:
        y, x = (3 * motions).floor().long().unbind(2)
        return ((7 * y - 5 * x) % 11) * (motions != 0).any(2)

    assert (worth(together) > 0).any(1).sum() > 100
    for a, b in zip(choose(worth(alone), alone), choose(worth(together), together)):
        assert same_bits(a, b)


def test_candidates_by_hand():
    given = torch.tensor(
        [[[2.0, 0.0], [8.0, 0.0], [9.0, 0.0]], [[5.0, 5.0], [0.0, 3.0], [1.0, 1.0]]], dtype=torch.float64
    )
    available = torch.tensor([[True, True, True], [False, True, False]])
    intervals = torch.tensor([[1.0, 2.0, 3.0]] * 2, dtype=torch.float64)
    found = candidates_of(given, available, intervals, torch.tensor([[0.5, -1.0], [0.0, 0.0]], dtype=torch.float64))
    assert found[0].tolist() == [[3.0, 0.0], [2.0, 0.0], [4.0, 0.0], [3.0, 0.0], [0.5, -1.0]]
    assert found[1].tolist() == [[0.0, 1.5], [0.0, 0.0], [0.0, 1.5], [0.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("seed", range(5))
def test_inherited_motion_equals_the_loop(seed):
    rng = np.random.default_rng(seed)
    shape, num_nodes, num_above = (3, 9, 11), 12, 4
    node = rng.integers(0, num_nodes + 1, shape)
    node[node == 3] = num_nodes  # a component without pixels
    above = np.where(rng.random(shape) < 0.3, -1, node % num_above)
    above[node == 5] = -1  # one without a coarser component
    occupied = rng.random(shape) < 0.5
    motions = rng.normal(size=(num_above, 2))
    listed = np.flatnonzero(occupied)
    found = inherit(
        torch.from_numpy(node.ravel()[listed]),
        num_nodes,
        torch.from_numpy(np.where(above < 0, num_above, above).ravel()[listed]),
        torch.from_numpy(motions),
    )
    rows = [tuple(f) for f in motions.tolist()]
    expected = [ref.inherit((node == i) & occupied, above, rows) for i in range(num_nodes)]
    assert found.tolist() == [list(f) for f in expected]
    assert found[3].tolist() == found[5].tolist() == [0.0, 0.0]


def test_the_first_pixel_decides_where_components_are_not_nested():
    node, above = torch.tensor([1, 0, 0, 1, 0, 2]), torch.tensor([2, 3, 1, 0, 0, 0])  # 3 = none
    motion = torch.tensor([[1.0, 0.0], [0.0, 2.0], [3.0, 3.0]], dtype=torch.float64)
    assert inherit(node, 2, above, motion).tolist() == [[0.0, 2.0], [3.0, 3.0]]


def test_nothing():
    none = torch.zeros((0, 3, 2), dtype=torch.float64)
    no_motion = none[:, 0]
    found = candidates_of(none, none[:, :, 0].bool(), none[:, :, 0], no_motion)
    assert found.shape == (0, 5, 2)
    nobody = torch.zeros(0, dtype=torch.int64)
    assert inherit(nobody, 0, nobody, no_motion).shape == (0, 2)
    assert inherit(nobody, 2, nobody, no_motion).tolist() == [[0.0, 0.0]] * 2


@pytest.mark.cuda
@needs_gpu
def test_candidates_on_cuda_equal_cpu():
    given = list(map(torch.from_numpy, estimates(7)))
    assert same_bits(candidates_of(*(v.cuda() for v in given)), candidates_of(*given))
