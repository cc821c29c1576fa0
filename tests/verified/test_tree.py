"""The tree of components: the reference's winners on random trees, known ones by hand."""

from __future__ import annotations

from typing import List, Optional, Tuple

import numpy as np
import oracle as ref
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import needs_gpu, same_bits

from cflow_torch.verified.component_tree import Groups, choose_groups

Tree = Tuple[List[List[int]], List[List[int]]]


def as_tensors(nodes, worths):
    counts = [len(worth) for worth in worths]
    return (
        [torch.tensor([i if i >= 0 else n for i in node], dtype=torch.int64) for node, n in zip(nodes, counts)],
        [torch.tensor(worth, dtype=torch.int64) for worth in worths],
    )


def found(groups: Groups, worths) -> List[Optional[Tuple[int, int]]]:
    """Level and component of each pixel; also that groups are numbered by their first pixel."""
    names = [(level, i) for level, worth in enumerate(worths) for i in range(len(worth))]
    of_group = [names[c] for c in groups.component.tolist()]
    numbers = groups.of_pixel.tolist()
    seen = list(dict.fromkeys(g for g in numbers if g < len(of_group)))
    assert seen == list(range(len(of_group)))
    assert groups.first.tolist() == [numbers.index(g) for g in seen]
    return [of_group[g] if g < len(of_group) else None for g in numbers]


def numbered(labels: List[int]) -> List[int]:
    names = sorted({label for label in labels if label >= 0})
    return [names.index(label) if label >= 0 else -1 for label in labels]


@st.composite
def trees(draw, num_levels: int = 3) -> Tree:
    """Labels by level, mostly nested, with holes and with a few pixels anywhere; small worths, so that draws occur."""
    num_pixels = draw(st.integers(0, 25))
    nodes, above = [], [0] * num_pixels
    for _ in range(num_levels):
        parts = draw(st.lists(st.integers(0, 2), min_size=num_pixels, max_size=num_pixels))
        noise = draw(st.lists(st.integers(-2, 12), min_size=num_pixels, max_size=num_pixels))
        labels = [3 * max(a, 0) + part for a, part in zip(above, parts)]
        labels = [{-2: -1, 0: 0}.get(n, label) for label, n in zip(labels, noise)]
        above = numbered(labels)
        nodes.append(above)
    worths = [[draw(st.integers(0, 4)) for _ in range(max(node, default=-1) + 1)] for node in nodes]
    return nodes, worths


@settings(max_examples=300, deadline=None)
@given(trees())
def test_winners_equal_the_reference(tree):
    assert found(choose_groups(*as_tensors(*tree)), tree[1]) == ref.winners(*tree)


@settings(max_examples=100, deadline=None)
@given(trees(), trees())
def test_windows_in_a_batch_win_as_they_do_alone(first, second):
    nodes, worths = [], []
    for a, b, worth_a, worth_b in zip(first[0], second[0], first[1], second[1]):
        nodes.append(a + [i if i < 0 else i + len(worth_a) for i in b])
        worths.append(worth_a + worth_b)
    alone = [found(choose_groups(*as_tensors(*tree)), tree[1]) for tree in (first, second)]
    moved = [None if w is None else (w[0], w[1] + len(first[1][w[0]])) for w in alone[1]]
    assert found(choose_groups(*as_tensors(nodes, worths)), worths) == alone[0] + moved


def winners(nodes, worths):
    result = found(choose_groups(*as_tensors(nodes, worths)), worths)
    assert result == ref.winners(nodes, worths)
    return result


def test_the_whole_must_be_worth_more_than_its_parts_together():
    nodes = [[0, 0, 0, 0], [0, 0, 1, -1]]
    assert winners(nodes, [[6], [3, 2]]) == [(0, 0)] * 4  # the pixel without a part of its own goes along
    assert winners(nodes, [[5], [3, 2]]) == [(1, 0), (1, 0), (1, 1), None]
    assert winners(nodes, [[0], [0, 0]]) == [(1, 0), (1, 0), (1, 1), None]


def test_parts_pass_on_what_their_component_is_worth():
    nodes = [[0, 0, 0, 0], [0, 0, 1, 1], [0, 1, 2, 3]]
    # Left the middle level wins with 7 against 3, right its parts do with 4 against 1.
    assert winners(nodes, [[11], [7, 1], [1, 2, 2, 2]]) == [(1, 0), (1, 0), (2, 2), (2, 3)]
    assert winners(nodes, [[12], [7, 1], [1, 2, 2, 2]]) == [(0, 0)] * 4


def test_a_part_in_two_wholes_counts_for_the_first():
    nodes = [[-1, 0, 1, 1], [0, 0, 0, 1]]
    assert winners(nodes, [[3, 2], [3, 1]]) == [(1, 0), (1, 0), (0, 1), (0, 1)]


def test_one_level_and_no_pixels():
    assert winners([[0, -1, 1]], [[0, 5]]) == [(0, 0), None, (0, 1)]
    assert winners([[], []], [[], []]) == []


@pytest.mark.cuda
@needs_gpu
def test_on_cuda_as_on_cpu():
    rng = np.random.default_rng(0)
    nodes = [torch.from_numpy(rng.integers(0, n + 1, 5000)) for n in (20, 60, 200)]
    worths = [torch.from_numpy(rng.integers(0, m, n)) for n, m in ((20, 30), (60, 10), (200, 4))]
    cpu = choose_groups(nodes, worths)
    gpu = choose_groups([n.cuda() for n in nodes], [w.cuda() for w in worths])
    for name in ("of_pixel", "component", "first"):
        assert same_bits(getattr(gpu, name), getattr(cpu, name))
