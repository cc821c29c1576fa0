"""Motion candidates: the oracle's peaks and motions; sweeps that a window lacks change no choice."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle
from oracle import candidates as oracle
from oracle.changed_pixels import Change
from oracle.component_tree import grow
from scenes import config, scene, sweeps_of

from cflow_torch.verified import candidates as fast
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import find_components, movable_nodes


def distinct(motions: Sequence[Sequence[float]]) -> list[float]:
    """Motions in the order in which ties are decided, flat; without those of 0, which stand for what is not known."""
    rounded = [(round(y, 6) + 0.0, round(x, 6) + 0.0) for y, x in motions]
    return [value for motion in dict.fromkeys(rounded) if any(motion) for value in motion]


@pytest.mark.parametrize("largest", [1 << 12, 60])
def test_candidates_and_scores_equal_the_oracle_in_a_batch(largest, monkeypatch):
    for module, name in ((fast, "_LARGEST_BOX"), (oracle, "LARGEST_BOX")):
        monkeypatch.setattr(module, name, largest)
    settings = config("verified", num_history=2, max_speed=8.0, pixel_sizes=(0.36, 0.12))
    sweeps, moved, coarse = sweeps_of([scene(seed, num_history=seed % 3) for seed in range(4)], settings), 0, 0
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    has_changed = every & (sweeps.pixels.col % 3 > 0) & sweeps.has_history[sweeps.pixels.window]
    components = find_components(sweeps, ChangedPixels(every, has_changed), (3, 1))
    nodes = movable_nodes(sweeps, components, None)
    found = fast.propose(nodes, components, sweeps, settings)
    assert not (torch.signbit(found.motion) & (found.motion == 0)).any()
    numbers: dict[tuple[int, ...], int] = {}
    of_pixels = (nodes.members.step, nodes.members.row, nodes.members.col)
    columns = (nodes.node, nodes.window[nodes.node], nodes.level[nodes.node], *of_pixels)
    for number, *name in zip(*(values.tolist() for values in columns)):
        numbers.setdefault(tuple(name), number)
    checked = 0
    for window in range(4):
        drawn = for_oracle(sweeps, window)
        changed = {p for p in drawn.pixels() if p[2] % 3 > 0 and len(drawn.images) > 2}
        tree = grow(drawn, Change(set(drawn.pixels()), changed), settings.replace(max_object_length=None))
        motions, scores = oracle.propose(tree.nodes, settings)
        for node, of_node, score in zip(tree.nodes, motions, scores):
            number = numbers[(window, node.level, *node.members[0])]
            mine, expected = (distinct(motions) for motions in (found.motion[number].tolist(), of_node))
            assert mine == pytest.approx(expected, abs=2e-6)
            assert float(found.score[number]) == pytest.approx(score, abs=1e-6)
            moved, checked = moved + len(mine), checked + 1
            coarse += oracle.block_of(node, settings) > (3, 1)[min(node.level, 1)]
    assert checked == nodes.count and moved > 100 and (coarse > 5) == (largest == 60)


def random_estimates(seed: int, num_sweeps: int):
    """Whole and parabola's pixels by whole and uneven steps: zeros, ties and opposites abound."""
    rng, count = np.random.default_rng(seed), 300
    whole = rng.integers(-3, 4, (count, num_sweeps, 2)) * (rng.random((count, num_sweeps, 1)) < 0.8)
    free = whole + rng.uniform(-0.5, 0.5, whole.shape)
    given = np.where(rng.random((count, 1, 1)) < 0.6, whole, free).astype(np.float64)
    available = rng.random((count, num_sweeps)) < 0.7
    intervals = np.where(rng.random((count, 1)) < 0.7, 1.0, 1.0625) * np.arange(1, num_sweeps + 1)
    given[~available], intervals[~available] = np.nan, 0.0  # must not be looked at
    return tuple(map(torch.from_numpy, (given, available, intervals)))


@pytest.mark.parametrize("num_sweeps", [1, 2, 3, 5])
def test_motions_equal_the_oracle(num_sweeps):
    given, available, intervals = random_estimates(num_sweeps, num_sweeps)
    found = fast.list_motions(given, available, intervals)
    assert found.shape == (300, num_sweeps + (num_sweeps > 1), 2)
    assert not (torch.signbit(found) & (found == 0)).any()
    for mine, f, known, k in zip(*(v.tolist() for v in (found, given, available, intervals))):
        estimates = [tuple(v) if is_known else None for v, is_known in zip(f, known)]
        np.testing.assert_allclose(mine, oracle.list_motions(estimates, k), atol=1e-9)
