"""Objects under overhangs: boxes above each other, by hand; a car under a crown, alone or in a batch."""

from __future__ import annotations

import itertools
from typing import Sequence, Tuple

import numpy as np
import pytest
import torch
from scenes import assert_same_bits, reordered, rows_of, sweeps_of
from turning_car import MODEL, upright_box

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import NodeKind, find_components, movable_nodes
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.overhangs import add_overhung
from cflow_torch.verified.spacing import Spacing
from cflow_torch.windows.collation import make_batch

REGION = (-9.0, -7.0, -2.0, 9.0, 7.0, 40.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION, min_height=None)

Box = Tuple[Tuple[float, ...], Tuple[float, ...]]  # lower and upper corner, metres
CROWN: Box = ((-3.0, -3.0, 4.0), (3.0, 3.0, 6.0))
HIGH_CROWN: Box = ((-3.0, -3.0, 6.0), (3.0, 3.0, 8.0))


def high(low: float, top: float) -> Box:
    """A box of the size of a car, of some heights."""
    return (-2.0, -0.9, low), (2.0, 0.9, top)


CAR = high(-1.7, -0.05)


def filled(box: Box, seed: int) -> np.ndarray:
    """Points all over a box, 60 in a cubic metre."""
    low, high = np.array(box)
    return np.random.default_rng(seed).uniform(low, high, (max(30, int(60 * np.prod(high - low))), 3))


def overhung(boxes: Sequence[Box]) -> tuple[int, torch.Tensor]:
    """Of a pair of sweeps of boxes: number of nodes under overhangs; heights of the points that are copied."""
    pc1, pc0 = (Sweep(np.concatenate([filled(box, seed) for box in boxes])) for seed in (0, 1))
    sweeps = sweeps_of([Window(pc0, pc1)], SETTINGS)
    nothing = torch.zeros(sweeps.num_pixels, dtype=torch.bool)
    components = find_components(sweeps, ChangedPixels(nothing, nothing, nothing), (1,))
    tree_nodes = movable_nodes(sweeps, components, 3.0)
    drawn, nodes = add_overhung(sweeps, components, tree_nodes)
    added = slice(tree_nodes.count, None)
    assert torch.equal(nodes.pixel[: len(tree_nodes.pixel)], tree_nodes.pixel)
    assert (nodes.kind[added] == NodeKind.OVERHUNG).all() and (nodes.by_parent.of_item[added] == nodes.count).all()
    assert (nodes.window[added] == 1).all() and (drawn.pixels.window[nodes.pixel[len(tree_nodes.pixel) :]] == 1).all()
    return nodes.count - tree_nodes.count, sweeps.batch.positions[2, drawn.copied]


@pytest.mark.parametrize(
    "thing, others, is_under",
    [
        (CAR, [CROWN], True),
        (CAR, [], False),  # under nothing
        (CAR, [((-9.0, -3.0, 3.6), (9.0, 3.0, 4.4))], True),  # under a bridge
        (CAR, [((-3.0, -3.0, 1.05), (3.0, 3.0, 3.0))], True),  # two empty slices between
        (CAR, [((-3.0, -3.0, 0.55), (3.0, 3.0, 3.0))], False),  # one
        (high(-1.7, 3.4), [HIGH_CROWN], True),  # eleven slices, as a bus
        (high(-1.7, 3.9), [HIGH_CROWN], False),
        # At the border of the region.
        (((-2.0, 5.2, -1.7), (2.0, 6.8, 0.0)), [((-3.0, 4.6, 4.0), (3.0, 6.9, 6.0))], True),
        (high(-1.7, 4.2), [CROWN], False),  # it touches what is above
        (high(26.0, 27.6), [high(30.0, 32.0), ((6.0, 4.0, -1.7), (8.0, 6.0, -0.5))], True),  # far above another object
        (high(-1.9, -1.5), [CROWN, high(0.0, 1.0)], True),  # one between is above it, so it is not copied
    ],
)
def test_objects_under_an_overhang_become_nodes(thing, others, is_under):
    count, heights = overhung([thing, *others])
    assert count == is_under and heights.numel() == is_under * 2 * len(filled(thing, 0))
    assert not is_under or thing[0][2] <= heights.min() < heights.max() <= thing[1][2]


@pytest.mark.parametrize("dx, dy", itertools.product((-0.4, 0.0, 0.4), repeat=2))
def test_cells_that_touch_at_a_corner_are_one_object(dx, dy):
    low, top = (-0.95, -0.15, -1.9), (-0.95 + dx, -0.15 + dy, -1.4)
    pieces = [(corner, tuple(np.add(corner, 0.3))) for corner in (low, top)]
    assert overhung([*pieces, CROWN])[0] == 1


AVENUE: VerifiedConfig = MODEL.replace(num_history=3, point_cloud_range=(-7, -6, -3, 7, 6, 9))
STEP = 0.7  # metres per interval of the cars, along x


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
        x = start + STEP * k
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
    return float((result.residual_flow[rows] - torch.tensor((STEP, 0.0, 0.0))).norm(dim=1).mean())


@pytest.mark.parametrize("num_history, start", [(0, -1.0), (2, -1.0), (3, -6.0), (2, 6.5)])
def test_a_car_under_a_crown_has_its_motion(num_history, start):
    window = avenue(num_history, num_history, start)
    assert error_under_crown(window, VerifiedFlow(AVENUE)([window])[0]) < 0.1


def test_the_columns_of_copies_do_not_depend_on_other_windows():
    """In the second batch, the points of the other window are far apart."""
    grid = VerifiedFlow(AVENUE).grid(AVENUE.pixel_sizes[-1])
    counts = []
    for angles in ([0.0], [0.0, 0.1]):
        angle = torch.tensor(angles).double()
        spacing = Spacing(angle, angle, 2 * len(angles) - 1, False)
        batch = make_batch([avenue(0), avenue(0, 1)][: len(angles)], AVENUE, grid, torch.device("cpu"), 3)
        sweeps = HeightSlicedSweeps.of(batch, grid, None, lambda *_, spacing=spacing: spacing)
        pixels = sweeps.pixels[sweeps.points[(batch.image == 0).nonzero()[:, 0]].of_item]
        copies, _ = sweeps.columns.for_copies(sweeps.columns.column_of(pixels))
        counts.append(len(copies.cell))
    assert counts[0] == counts[1] > 100


def test_without_overhangs_a_car_under_a_crown_has_a_wrong_motion(monkeypatch):
    window, model = avenue(3), VerifiedFlow(AVENUE)
    (whole,) = model([window])
    crown = torch.from_numpy(window.pc0.points[:, 2] > 2.0)
    assert error_under_crown(window, whole) < 0.05 and not whole.residual_flow[crown].any()
    monkeypatch.setattr(VerifiedFlow, "add_overhung", staticmethod(lambda sweeps, components, tree: (sweeps, tree)))
    assert error_under_crown(window, model([window])[0]) > 0.3


def test_alone_or_in_a_batch_in_any_order_of_points():
    empty = Window(*[Sweep(np.full((3, 3), np.nan, np.float32))] * 2)
    windows = [avenue(2, 1), empty, avenue(0, 2), avenue(1, 3, -6.0)]
    model = VerifiedFlow(AVENUE)
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
        mixed, order = reordered(window)
        assert_same_bits(model([mixed])[0], rows_of(result, order))
