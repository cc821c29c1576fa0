"""Layers: the oracle's points on random boxes; what is one and what is none."""

from __future__ import annotations

from typing import List, Sequence, Tuple

import numpy as np
import pytest
import torch
from oracle import layers as oracle
from scenes import sweeps_of

from cflow_torch import Sweep, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified.layers import points_of_lower_layers

REGION = (-9.0, -7.0, -2.0, 9.0, 7.0, 30.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION, num_history=3, num_future=2, min_height=None)

Box = Tuple[Tuple[float, ...], Tuple[float, ...]]  # lower and upper corner, metres
CROWN: Box = ((-3.0, -3.0, 4.0), (3.0, 3.0, 6.0))
POST: Box = ((-0.5, 3.7, -1.8), (-0.2, 4.0, 0.0))  # it stands on the ground, beside everything


def slabs(seed: int, num_past: int = 2, num_future: int = 0) -> Window:
    """Boxes at all heights, some above others, in every sweep anew; NaN rows."""
    rng = np.random.default_rng(seed)
    boxes = [(rng.uniform((-9, -7, -2), (9, 7, 8)), rng.uniform((0.5, 0.5, 0.1), (5, 5, 4))) for _ in range(14)]
    sweeps = []
    for _ in range(num_past + num_future):
        points = [rng.uniform(-0.5, 0.5, (60, 3)) * size + place for place, size in boxes]
        points.append(rng.uniform((-9, -7, -2), (9, 7, 29), (10, 3)))
        points.append(np.full((4, 3), np.nan))
        sweeps.append(Sweep(np.concatenate(points).astype(np.float32)))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:num_past]), tuple(sweeps[num_past:]))


def lower(windows: Sequence[Window], share: float = 0.9) -> List[List[np.ndarray]]:
    """Of each window and sweep, (N,) bool: what is found, which is what the oracle finds in each window alone."""
    sweeps = sweeps_of(list(windows), SETTINGS)
    batch = sweeps.batch
    # Whether a point is at rest depends on where it is, so that it is the same in every batch.
    at_rest = batch.takes_part & ((batch.positions.abs().sum(0) * 1e3).frac() < share)
    found = points_of_lower_layers(sweeps, at_rest)
    assert found.dtype == torch.bool and not (found & ~at_rest).any()
    result = []
    for window in range(len(windows)):
        rows = [batch.image == window * batch.num_steps + step for step in range(batch.num_steps)]
        clouds = [batch.positions[:, row].T.numpy() for row in rows]
        expected = oracle.points_of_lower_layers(clouds, [at_rest[row].tolist() for row in rows], SETTINGS)
        result.append([found[row].numpy() for row in rows])
        for own, truth in zip(result[-1], expected):
            assert own.tolist() == truth.tolist()
    return result


def test_points_equal_the_oracle():
    shares = []
    for seed in range(6):
        # Windows that lack sweeps, have some after t+1, or nothing at all, beside others.
        windows = [slabs(10 * seed + i, 2 + (seed + i) % 3, 2 * (seed % 2)) for i in range(1 + seed % 3)]
        if seed % 3 == 2:
            windows[1] = Window(*[Sweep(np.zeros((0, 3), np.float32))] * 2)
        shares += [np.concatenate(masks).mean() for masks in lower(windows) if len(masks[1])]
    assert sum(0.05 < share < 0.5 for share in shares) > 6


def filled(box: Box, rng: np.random.Generator, density: float = 60.0) -> np.ndarray:
    """Points all over a box, so many in a cubic metre."""
    low, high = np.array(box)
    return rng.uniform(low, high, (max(30, int(density * np.prod(high - low))), 3))


def things(boxes: Sequence[Box]) -> Window:
    """Two sweeps of things that stand, box by box."""
    sweeps = [Sweep(np.concatenate([filled(box, np.random.default_rng(seed)) for box in boxes])) for seed in (0, 1)]
    return Window(sweeps[1], sweeps[0])


@pytest.mark.parametrize(
    "thing, others, is_lower",
    [
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 0.0)), [CROWN], True),
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 0.0)), [], False),  # under nothing
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 0.0)), [((-9.0, -3.0, 3.6), (9.0, 3.0, 4.4))], True),  # under a bridge
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 2.4)), [CROWN], True),  # a bus
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 4.4)), [((-3.0, -3.0, 6.0), (3.0, 3.0, 8.0))], False),  # taller than 5.5 m
        (((-2.0, -0.9, -1.7), (2.0, 0.9, -1.55)), [CROWN], False),  # flat
        (((-2.0, -0.9, 0.0), (2.0, 0.9, 1.7)), [CROWN], False),  # it does not stand on the ground
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 4.2)), [CROWN], False),  # it touches what is above
        (((-2.0, -0.9, 0.0), (2.0, 0.9, 1.0)), [CROWN, ((-2.0, -0.9, -1.9), (2.0, 0.9, -1.5))], False),  # between two
    ],
)
def test_what_is_a_lower_layer(thing, others, is_lower):
    window = things([thing, POST, *others])
    ((_, found),) = lower([window], 2.0)
    count = len(filled(thing, np.random.default_rng(0)))
    assert (found[:count] == is_lower).all()
    assert not found[count:].any() or others[1:]  # in the last case what lies below is one
