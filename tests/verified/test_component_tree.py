"""The component tree: the oracle's components, parents and winners on random ones."""

from __future__ import annotations

from typing import List, Optional, Tuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import for_oracle, from_images
from oracle import component_tree as oracle
from scenes import config

from cflow_torch.dense.clustering import Clusters, Pixels
from cflow_torch.verified.component_tree import Level, find_components, select_objects

Tree = Tuple[List[List[int]], List[List[int]]]


def random_images(seed: int, shape: tuple, density: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return (rng.integers(1, 16, shape) * (rng.random(shape) < density)).astype(np.uint8)


@pytest.mark.parametrize("is_undilated", [False, True])
@pytest.mark.parametrize("block", [1, 2, 3])
def test_components_equal_the_oracle(block, is_undilated):
    total = 0
    for seed, (shape, density) in enumerate([((2, 3, 23, 1), 0.15), ((3, 2, 40, 45), 0.01), ((2, 4, 63, 60), 0.01)]):
        settings = config("verified", connectivity=(4, 8)[seed % 2], max_extent=3.0, max_object=1.3)
        sweeps = from_images(random_images(seed, shape, density))
        level, start = find_components(sweeps, block, is_undilated, settings), 0
        for window in range(shape[0]):
            expected = oracle.find_components(for_oracle(sweeps, window), block, is_undilated, settings)
            count, mine = len(expected.members), level.component[sweeps.window == window]
            assert torch.where(mine < level.num_components, mine - start, -1).tolist() == expected.component
            assert np.array_equal(level.images[window], expected.images)
            assert level.too_long[start : start + count].tolist() == expected.too_long
            start += count
        assert level.num_components == start
        total += start
    assert total > 10


def as_level(labels: List[int]) -> Level:
    """A level that knows nothing but the component of each pixel, -1 = none."""
    count = max(labels, default=-1) + 1
    nothing = torch.zeros(0, dtype=torch.int64)
    clusters = Clusters(torch.zeros(count), nothing, nothing, Pixels(nothing, nothing, nothing, nothing))
    component = torch.tensor([label if label >= 0 else count for label in labels], dtype=torch.int64)
    return Level(1, False, nothing, clusters, component, *torch.zeros((2, count), dtype=torch.bool))


def numbered(labels: List[int]) -> List[int]:
    names = sorted({label for label in labels if label >= 0})
    return [names.index(label) if label >= 0 else -1 for label in labels]


@st.composite
def trees(draw, num_levels: int = 3) -> Tree:
    """Labels by level, mostly nested, with holes and with a few pixels anywhere; little evidence, so draws occur."""
    num_pixels = draw(st.integers(0, 25))
    levels, above = [], [0] * num_pixels
    for _ in range(num_levels):
        parts = draw(st.lists(st.integers(0, 2), min_size=num_pixels, max_size=num_pixels))
        noise = draw(st.lists(st.integers(-2, 12), min_size=num_pixels, max_size=num_pixels))
        labels = [3 * max(a, 0) + part for a, part in zip(above, parts)]
        above = numbered([{-2: -1, 0: 0}.get(n, label) for label, n in zip(labels, noise)])
        levels.append(above)
    return levels, [[draw(st.integers(0, 4)) for _ in range(max(level, default=-1) + 1)] for level in levels]


def winners(levels: List[List[int]], evidence: List[List[int]]) -> List[Optional[Tuple[int, int]]]:
    """Level and component of each pixel; also that objects are numbered by their first pixel."""
    objects = select_objects(list(map(as_level, levels)), [torch.tensor(e, dtype=torch.int64) for e in evidence])
    names = [(level, i) for level, values in enumerate(evidence) for i in range(len(values))]
    of_object, numbers = [names[c] for c in objects.component.tolist()], objects.of_pixel.tolist()
    seen = list(dict.fromkeys(n for n in numbers if n < objects.count))
    assert seen == list(range(objects.count))
    assert objects.first.tolist() == [numbers.index(n) for n in seen]
    return [of_object[n] if n < objects.count else None for n in numbers]


@settings(max_examples=80, deadline=None, derandomize=True)
@given(trees())
def test_parents_and_winners_equal_the_oracle(tree):
    levels, evidence = tree
    assert winners(levels, evidence) == oracle.winners(levels, evidence)
    for above, level in zip(levels, levels[1:]):
        whole, part = as_level(above), as_level(level)
        parent = part.parents(whole)
        assert torch.where(parent < whole.num_components, parent, -1).tolist() == oracle.parents(level, above)
        assert part.equals_parent(whole, parent).tolist() == oracle.equals_parent(level, above)
