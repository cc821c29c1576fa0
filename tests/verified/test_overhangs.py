"""Objects under overhangs: the oracle's nodes on random slabs; what is one and what is none; a car under a crown."""

from __future__ import annotations

from typing import Sequence, Set, Tuple

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle
from oracle import overhangs as oracle
from oracle.changed_pixels import Change
from oracle.component_tree import grow
from scenes import assert_same, assert_same_bits, flow_as_oracle, needs_gpu, reordered, rows_of, sweeps_of
from turning_car import MODEL, upright_box

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified import method
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import find_components, movable_nodes
from cflow_torch.verified.overhangs import add_overhung

REGION = (-9.0, -7.0, -2.0, 9.0, 7.0, 40.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION, num_history=3, min_height=None)

Box = Tuple[Tuple[float, ...], Tuple[float, ...]]  # lower and upper corner, metres
CROWN: Box = ((-3.0, -3.0, 4.0), (3.0, 3.0, 6.0))
POST: Box = ((-0.5, 3.7, -1.8), (-0.2, 4.0, 0.0))  # it stands on the ground, beside everything
CAR: Box = ((-2.0, -0.9, -1.7), (2.0, 0.9, 0.0))
Found = Set[Tuple[Tuple[int, int, int], ...]]  # pixels of the nodes


def slabs(seed: int, num_sweeps: int = 2) -> Window:
    """Boxes at all heights, some above others, in every sweep anew; NaN rows."""
    rng = np.random.default_rng(seed)
    boxes = [(rng.uniform((-9, -7, -2), (9, 7, 8)), rng.uniform((0.5, 0.5, 0.1), (5, 5, 4))) for _ in range(14)]
    sweeps = []
    for _ in range(num_sweeps):
        points = [rng.uniform(-0.5, 0.5, (60, 3)) * size + place for place, size in boxes]
        points.append(rng.uniform((-9, -7, -2), (9, 7, 39), (10, 3)))
        points.append(np.full((4, 3), np.nan))
        sweeps.append(Sweep(np.concatenate(points).astype(np.float32)))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def overhung(windows: Sequence[Window]) -> list[Found]:
    """Of each window, what the oracle finds in it alone: the pixels of its nodes, and the images of the copies."""
    sweeps = sweeps_of(list(windows), SETTINGS)
    # Columns of pixels at one side are missing nowhere, so that some components may not move.
    is_missing = sweeps.pixels.col > 12
    change = ChangedPixels(is_missing, torch.zeros_like(is_missing))
    components = find_components(sweeps, change, (1,))
    tree_nodes = movable_nodes(sweeps, components, 3.0)
    drawn, nodes = add_overhung(sweeps, components, tree_nodes)
    assert torch.equal(nodes.pixel[: len(tree_nodes.pixel)], tree_nodes.pixel)
    result = []
    for window in range(len(windows)):
        alone = for_oracle(sweeps, window)
        tree = grow(
            alone, Change({p for p in alone.pixels() if p[2] > 12}, set()), SETTINGS.replace(max_object_length=3.0)
        )
        copies, expected = oracle.find_overhung(alone, tree.may_move, len(tree.levels) + 1)
        found: Found = set()
        for node in range(tree_nodes.count, nodes.count):
            assert nodes.level[node] == len(tree.levels) + 1 and nodes.parent[node] == nodes.count
            if nodes.window[node] == window + len(windows):
                members = drawn.pixels.take(nodes.pixel[nodes.node == node])
                found.add(tuple(zip(members.step.tolist(), members.row.tolist(), members.col.tolist())))
        assert found == {node.members for node in expected}
        mine = (drawn.pixels.window == window + len(windows)).nonzero()[:, 0]
        members = drawn.pixels.take(mine)
        slices = zip(*(v.tolist() for v in (members.step, members.row, members.col, members.slices)))
        assert {tuple(place): own for *place, own in slices} == {p: copies.at(*p) for p in copies.pixels()}
        result.append(found)
    return result


def test_nodes_equal_the_oracle_in_a_batch():
    count = 0
    for seed in range(6):
        # Windows that lack sweeps, or have nothing at all, beside others.
        windows = [slabs(10 * seed + i, 2 + (seed + i) % 3) for i in range(1 + seed % 3)]
        if seed % 3 == 2:
            windows[1] = Window(*[Sweep(np.zeros((0, 3), np.float32))] * 2)
        count += sum(map(len, overhung(windows)))
    assert count > 10


# --------------------------------------------------------------------------------------------------- hand-made truth


def filled(box: Box, seed: int) -> np.ndarray:
    """Points all over a box, 60 in a cubic metre."""
    low, high = np.array(box)
    return np.random.default_rng(seed).uniform(low, high, (max(30, int(60 * np.prod(high - low))), 3))


@pytest.mark.parametrize(
    "thing, others, is_under",
    [
        (CAR, [CROWN], True),
        (CAR, [], False),  # under nothing
        (CAR, [((-9.0, -3.0, 3.6), (9.0, 3.0, 4.4))], True),  # under a bridge
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 2.4)), [CROWN], True),  # a bus
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 4.4)), [((-3.0, -3.0, 6.0), (3.0, 3.0, 8.0))], False),  # taller than 5.5 m
        (((-2.0, -0.9, -1.7), (2.0, 0.9, -1.55)), [CROWN], False),  # flat
        (((-2.0, -0.9, 0.0), (2.0, 0.9, 1.7)), [CROWN], False),  # it does not stand on the ground
        (((-2.0, -0.9, -1.7), (2.0, 0.9, 4.2)), [CROWN], False),  # it touches what is above
        (((-2.0, -0.9, 0.0), (2.0, 0.9, 1.0)), [CROWN, ((-2.0, -0.9, -1.9), (2.0, 0.9, -1.5))], False),  # between two
    ],
)
def test_which_shapes_are_objects_under_an_overhang(thing, others, is_under):
    pc1, pc0 = (Sweep(np.concatenate([filled(box, seed) for box in (thing, POST, *others)])) for seed in (0, 1))
    (found,) = overhung([Window(pc0, pc1)])
    assert len(found) == is_under


# ------------------------------------------------------------------------------------------------ the whole method

AVENUE: VerifiedConfig = MODEL.replace(num_history=3, point_cloud_range=(-7, -6, -3, 7, 6, 9))
WAY = 0.7  # metres per interval of the cars, along x


def avenue(num_history: int, seed: int = 0, start: float = -1.0) -> Window:
    """A car drives under the crown of a tree, another one beside it in the open.

    Args:
        num_history: sweeps before t.
        seed: of the points.
        start: x of both cars at t+1.
    """
    rng, sweeps = np.random.default_rng(seed), []
    crown = rng.uniform((-4.5, -1.9, 2.2), (4.5, 1.9, 4.0), (800, 3))
    for k in range(0, -2 - num_history, -1):
        x = start + WAY * k
        parts = [
            upright_box((x, 0.0), (3.6, 1.7), 0.0, rng, 500) * (1, 1, 0.6),
            upright_box((x, -4.0), (3.6, 1.7), 0.0, rng, 500) * (1, 1, 0.6),
            crown + rng.normal(0.0, 0.01, crown.shape),
            rng.uniform((-6.5, -5.5, -1.0), (-6.2, -5.2, -0.2), (20, 3)),
        ]
        sweeps.append(Sweep(np.concatenate(parts).astype(np.float32)))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def error_under_crown(window: Window, result) -> float:
    rows = torch.from_numpy((np.abs(window.pc0.points[:, 1]) < 1.0) & (window.pc0.points[:, 2] < 1.5)) & result.is_valid
    assert rows.sum() > 100
    return float((result.residual_flow[rows] - torch.tensor((WAY, 0.0, 0.0))).norm(dim=1).mean())


@pytest.mark.parametrize("num_history, start", [(0, -1.0), (2, -1.0), (3, -6.0), (2, 6.5)])
def test_a_car_under_a_crown_has_its_motion_which_is_the_oracles(num_history, start):
    window = avenue(num_history, num_history, start)
    assert error_under_crown(window, flow_as_oracle(window, AVENUE)) < 0.1


def test_without_overhangs_a_car_under_a_crown_has_a_wrong_motion(monkeypatch):
    window, model = avenue(3), VerifiedFlow(AVENUE)
    (whole,) = model([window])
    crown = torch.from_numpy(window.pc0.points[:, 2] > 2.0)
    assert error_under_crown(window, whole) < 0.05 and not whole.residual_flow[crown].any()
    monkeypatch.setattr(method, "add_overhung", lambda sweeps, components, nodes: (sweeps, nodes))
    assert error_under_crown(window, model([window])[0]) > 0.3


def test_alone_or_in_a_batch_in_any_order_of_points():
    empty = Window(*[Sweep(np.full((3, 3), np.nan, np.float32))] * 2)
    windows = [avenue(2, 1), empty, avenue(0, 2), avenue(1, 3, -6.0)]
    model = VerifiedFlow(AVENUE)
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
        mixed, order = reordered(window)
        assert_same_bits(model([mixed])[0], rows_of(result, order))


@pytest.mark.cuda
@needs_gpu
def test_cuda_equals_cpu():
    windows = [avenue(2, 1), avenue(0, 2), avenue(1, 3, -6.0)]
    for on_cpu, on_gpu in zip(*(VerifiedFlow(AVENUE, device)(windows) for device in ("cpu", "cuda"))):
        assert_same(on_gpu, on_cpu, atol=1e-4)
