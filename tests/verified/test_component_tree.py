"""The component tree: the oracle's components, nodes and cut on random images; nesting; the price of parts."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import FrozenSet, NamedTuple, Tuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import for_oracle, from_images
from oracle import component_tree as oracle
from oracle.height_slices import SlicedSweeps, Vector

from cflow_torch.config import VerifiedConfig
from cflow_torch.ops.groups import Groups
from cflow_torch.verified.changed_pixels import ChangedPixels
from cflow_torch.verified.component_tree import (
    Components,
    NodeKind,
    Tree,
    find_components,
    movable_nodes,
)
from cflow_torch.verified.height_slices import HeightSlicedSweeps
from cflow_torch.verified.paired_test import Verdict
from cflow_torch.verified.selection import select_objects

SIZE = 0.25
Name = Tuple[FrozenSet[int], int]  # pixels of a window and level of a node


class Grown(NamedTuple):
    """Windows of random pixels, some of which are missing or have changed, and their trees."""

    sweeps: HeightSlicedSweeps
    components: Components
    nodes: Tree
    windows: list[SlicedSweeps]
    trees: list[oracle.Tree]

    def names(self, window: int) -> list[Name]:
        """Of all nodes of a window, in the order of the oracle's list."""
        return [(frozenset(node.members.tolist()), node.level) for node in self.trees[window].nodes]

    def fast_names(self) -> list[Name]:
        """Of all nodes of all windows."""
        window = self.sweeps.pixels.window
        so_far = (window[:, None] == torch.arange(len(self.trees))).cumsum(0)
        number = so_far[torch.arange(len(window)), window] - 1  # within its window
        pixels: list[list[int]] = [[] for _ in range(self.nodes.count)]
        for node, pixel in zip(self.nodes.members.of_item.tolist(), number[self.nodes.pixel].tolist()):
            pixels[node].append(pixel)
        return [(frozenset(own), level) for own, level in zip(pixels, levels_of(self.nodes))]


def levels_of(tree: Tree) -> list[int]:
    """Levels of the nodes; L = changed pixels."""
    return torch.where(tree.kind == NodeKind.CHANGED, tree.num_levels, tree.kind).tolist()


@lru_cache(maxsize=None)
def grown(seed: int, longest: float | None = 3.0, blocks=(4, 2, 1), shape=(3, 3, 50, 47), density=0.02) -> Grown:
    rng = np.random.default_rng(seed)
    images = (rng.integers(1, 16, shape) * (rng.random(shape) < density)).astype(np.uint8)
    elapsed = np.tile(np.arange(shape[1], dtype=np.float64), (shape[0], 1))
    images[-1, 2:], elapsed[-1, 2:] = 0, 0  # a pair among others
    sweeps = from_images(images, SIZE, elapsed)
    # Few pixels are missing in some stripes, so that the static test decides, and most of them in others.
    odds = np.choose(sweeps.pixels.row_col[1].numpy() // 6 % 4, (0.0, 0.15, 0.1, 0.95))
    is_missing = torch.from_numpy(rng.random(sweeps.num_pixels) < odds) & sweeps.has_history[sweeps.pixels.window]
    has_changed = is_missing & torch.from_numpy(rng.random(sweeps.num_pixels) < 0.8)
    change = ChangedPixels(is_missing, has_changed, is_missing)
    config = VerifiedConfig(pixel_sizes=tuple(SIZE * block for block in blocks), max_object_length=longest)
    windows, trees = [for_oracle(sweeps, window) for window in range(shape[0])], []
    for window, drawn in enumerate(windows):
        mine = sweeps.pixels.window == window
        trees.append(oracle.grow(drawn, np.stack([values[mine].numpy() for values in change]), config))
    components = find_components(sweeps, change, blocks)
    return Grown(sweeps, components, movable_nodes(sweeps, components, longest), windows, trees)


def same_groups(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays give the same pixels the same names, whatever the names are."""
    return len({*zip(a.tolist(), b.tolist())}) == len({*a.tolist()}) == len({*b.tolist()})


@pytest.mark.parametrize("blocks, longest", [((4, 2, 1), 3.0), ((3, 1), None), ((1,), 1.3)])
def test_components_and_nodes_equal_the_oracle(blocks, longest):
    counts = np.zeros(3, dtype=int)
    for seed in range(6):
        found = grown(seed, longest, blocks)
        names, none = found.fast_names(), found.nodes.count
        parents = [None if parent == none else names[parent] for parent in found.nodes.by_parent.of_item.tolist()]
        given = list(zip(names, parents))
        for window, tree in enumerate(found.trees):
            mine = found.sweeps.pixels.window == window
            for level, roots in enumerate(tree.levels):
                assert same_groups(found.components.of_level(level).of_item[mine].numpy(), roots)
            own = found.names(window)
            expected = {(name, None if node.parent < 0 else own[node.parent]) for name, node in zip(own, tree.nodes)}
            of_window = (found.nodes.window == window).tolist()
            assert {node for node, is_mine in zip(given, of_window) if is_mine} == expected
            assert len(expected) == sum(of_window)
            counts += (
                len(expected),
                sum(parent is not None for _, parent in expected),
                sum(level > len(blocks) for (_, level), _ in expected),
            )
    assert counts[0] > 30 and counts[1] > 10 * (len(blocks) > 1) and counts[2] > 5, counts


def test_scales_are_nested():
    found = grown(0, density=0.04)
    components = found.components
    levels = [components.of_level(level) for level in range(components.num_levels)]
    for coarse, fine in zip(levels, levels[1:]):
        assert torch.equal(components.by_parent.of_item[fine.of_item], coarse.of_item)
    assert components.size.sum() == sum(len(level.of_item) for level in levels) + len(components.changed)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.integers(0, 5), st.integers(0, 1000))
def test_the_cut_equals_the_oracle(seed, of_evidence):
    found, rng = grown(seed), np.random.default_rng(of_evidence)
    verdict_of: dict[tuple[int, Name], tuple[Vector, int]] = {}
    evidence = torch.from_numpy(rng.choice([0, 0, 5, 63, 64, 65, 70, 130, 300], found.nodes.count))
    motion = torch.from_numpy(rng.uniform(-4, 4, (found.nodes.count, 2)).round(1)) * (evidence > 0)[:, None]
    names = found.fast_names()
    for window, name, y_x, value in zip(found.nodes.window.tolist(), names, motion.tolist(), evidence.tolist()):
        verdict_of[window, name] = tuple(y_x), value
    verdict = Verdict(motion, evidence)
    # Random pixels hardly gain anything, so at z = 0 some nodes dissent.
    objects = select_objects(found.sweeps, found.components, found.nodes, verdict, 0.0)
    node = objects.by_node.of_item
    first = objects.by_object.first()
    assert torch.equal(objects.window, found.sweeps.pixels.window[first])
    assert torch.equal(first, first.sort().values)
    count = 0
    for window, tree in enumerate(found.trees):
        own = found.names(window)
        verdicts = zip(*[verdict_of[window, name] for name in own])
        expected, chosen = oracle.select_objects(found.windows[window], tree, *verdicts, 0.0)
        mine = objects.by_object.of_item[found.sweeps.pixels.window == window]
        is_own = objects.window == window
        number = torch.cat((is_own.cumsum(0) - 1, torch.tensor([-1])))  # in the window; the last one for no object
        assert number[mine].tolist() == expected.tolist()
        of_window = node[is_own].tolist()
        expected_names = [None if i < 0 else own[i] for i in chosen]
        assert [names[i] if i < len(names) else None for i in of_window] == expected_names
        count += len(chosen)
    assert count == objects.count


@pytest.mark.parametrize("whole, wins", [(0, False), (71, False), (72, False), (73, True)])
def test_a_component_wins_only_with_more_evidence_than_its_children_minus_their_price(whole, wins):
    # Two columns 0.75 m apart are one component at 0.5 m and two at 0.25 m: each is worth 100 - 64 = 36.
    images = np.zeros((1, 2, 9, 12), dtype=np.uint8)
    images[0, :, 2:6, 2], images[0, :, 2:6, 6] = 1, 1
    sweeps = from_images(images, SIZE)
    change = ChangedPixels(*torch.zeros((3, sweeps.num_pixels), dtype=torch.bool))
    components = find_components(sweeps, change, (2, 1))
    nodes = movable_nodes(sweeps, components, None)
    assert nodes.kind.tolist() == [0, 1, 1] and nodes.by_parent.of_item.tolist() == [3, 0, 0]
    alike = Verdict(torch.ones((3, 2), dtype=torch.float64), torch.tensor([whole, 100, 100]))
    objects = select_objects(sweeps, components, nodes, alike, 1.5)
    assert objects.by_node.of_item.tolist() == ([0] if wins else [1, 2])


@pytest.mark.parametrize("z, dissents", [(1.5, True), (100.0, False)])
def test_inside_a_car_a_cyclist_moves_by_himself_and_a_parked_car_is_static(z, dissents):
    # In rows of their own, with one row between, so that they are one component where it is dilated. The car moves by 4
    # pixels a sweep, the cyclist by 2.
    images = np.zeros((1, 4, 20, 40), dtype=np.uint8)
    for step in range(4):
        for row, first, length in ((3, 20 - 4 * step, 12), (6, 24 - 2 * step, 8), (9, 20, 12)):
            images[0, step, row : row + 2, first : first + length] = 15
    sweeps = from_images(images, SIZE)
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    components = find_components(sweeps, ChangedPixels(every, ~every, ~every), (2, 1))
    nodes = movable_nodes(sweeps, components, None)
    assert nodes.kind.tolist() == [0, 1, 2, 2, 2]
    speed = torch.tensor([4.0, 4.0, 4.0, 2.0, 0.0], dtype=torch.float64)
    motion = torch.stack((0 * speed, speed), 1)
    objects = select_objects(sweeps, components, nodes, Verdict(motion, torch.tensor([9000, 9000, 4000, 4000, 0])), z)
    row = sweeps.pixels.row_col[0]
    flow = objects.by_object.spread(objects.by_node.spread(motion))
    for first, own in ((3, 4.0), (6, 2.0), (9, 0.0)):
        assert (flow[(row == first) | (row == first + 1), 1] == (own if dissents else 4.0)).all()


def test_what_is_static_inside_a_car_takes_no_motion_of_its_parts():
    # A car that moves by 4 pixels a sweep, and two parked ones in one component of the middle level. One of these has a
    # motion that differs too little from that of the moving car to dissent, so it does what both parked cars do.
    images = np.zeros((1, 4, 20, 40), dtype=np.uint8)
    for step in range(4):
        for row, first in ((1, 20 - 4 * step), (6, 20), (9, 20)):
            images[0, step, row : row + 2, first : first + 12] = 15
    sweeps = from_images(images, SIZE)
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    components = find_components(sweeps, ChangedPixels(every, ~every, ~every), (3, 1))
    nodes = movable_nodes(sweeps, components, None)
    assert nodes.kind.tolist() == [0, 1, 1, 2, 2] and nodes.by_parent.of_item.tolist() == [5, 0, 0, 2, 2]
    speed = torch.tensor([4.0, 4.0, 0.0, 4.5, 0.0], dtype=torch.float64)
    motion = torch.stack((0 * speed, speed), 1)
    objects = select_objects(sweeps, components, nodes, Verdict(motion, torch.tensor([9000, 8000, 0, 50, 0])), 1.5)
    flow = objects.by_object.spread(objects.by_node.spread(motion))[:, 1]
    is_parked = sweeps.pixels.row_col[0] >= 6
    assert (flow[~is_parked] == 4.0).all() and (flow[is_parked] == 0.0).all()


@pytest.mark.parametrize("own, z, dissents", [(2.0, 1.5, True), (3.0, 1.5, False), (2.0, 100.0, False)])
def test_changed_pixels_inside_a_moving_car_move_by_themselves(own, z, dissents):
    # A person walks along the car, pixel to pixel, so no component of a level separates them. The pixels of the person
    # have changed. His motion must differ by two pixels from that of the car, which moves by 4.
    images = np.zeros((1, 4, 20, 40), dtype=np.uint8)
    for step in range(4):
        for row, first, length in ((3, 20 - 4 * step, 12), (5, 24 - int(own) * step, 8)):
            images[0, step, row : row + 2, first : first + length] = 15
    sweeps = from_images(images, SIZE)
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    is_person = sweeps.pixels.row_col[0] >= 5
    components = find_components(sweeps, ChangedPixels(every, is_person, ~every), (2, 1))
    nodes = movable_nodes(sweeps, components, None)
    assert nodes.kind.tolist() == [0, 1, NodeKind.CHANGED]
    speed = torch.tensor([4.0, 4.0, own], dtype=torch.float64)
    motion = torch.stack((0 * speed, speed), 1)
    objects = select_objects(sweeps, components, nodes, Verdict(motion, torch.tensor([9000, 8000, 4000])), z)
    flow = objects.by_object.spread(objects.by_node.spread(motion))[:, 1]
    assert (flow[~is_person] == 4.0).all()
    assert (flow[is_person] == (own if dissents else 4.0)).all()


def test_a_pixel_that_joined_a_moving_node_moves_with_it_although_a_later_node_of_it_has_no_evidence():
    images = np.zeros((1, 3, 9, 20), dtype=np.uint8)
    images[0, :2, 4, 2:5] = images[0, :2, 4, 9:12] = 1  # two components of changed pixels
    sweeps = from_images(images, SIZE)
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    components = find_components(sweeps, ChangedPixels(every, every, every), (1,))
    nodes = movable_nodes(sweeps, components, None)
    first, second = (nodes.kind == NodeKind.CHANGED).nonzero()[:, 0].tolist()
    joined = nodes.pixel[nodes.members.of_item == second][:1]
    members = Groups(torch.cat((nodes.members.of_item, joined * 0 + first)), nodes.count)
    nodes = replace(nodes, pixel=torch.cat((nodes.pixel, joined)), members=members)
    evidence = torch.zeros(nodes.count, dtype=torch.int64)
    evidence[first] = 100
    verdict = Verdict((evidence > 0)[:, None].double().expand(-1, 2), evidence)
    objects = select_objects(sweeps, components, nodes, verdict, 1.5)
    assert objects.by_node.of_item[objects.by_object.of_item[joined]].tolist() == [first]


@pytest.mark.parametrize("num_missing, may_move", [(0, False), (1, False), (2, True)])
def test_a_component_may_move_only_if_more_than_5_per_cent_are_missing(num_missing, may_move):
    images = np.zeros((1, 3, 9, 12), dtype=np.uint8)
    images[0, :2, 2:4, 1:6] = 1  # 20 pixels: one of them is 5 per cent
    sweeps = from_images(images, SIZE)
    is_missing = torch.arange(sweeps.num_pixels) < num_missing
    components = find_components(sweeps, ChangedPixels(is_missing, torch.zeros_like(is_missing), is_missing), (1,))
    assert movable_nodes(sweeps, components, None).count == may_move


@pytest.mark.parametrize("num_pixels, is_node", [(12, True), (13, False)])
def test_a_component_of_changed_pixels_is_a_node_only_up_to_3_m(num_pixels, is_node):
    images = np.zeros((1, 3, 9, 20), dtype=np.uint8)
    images[0, :2, 4, 2 : 2 + num_pixels] = 1
    sweeps = from_images(images, SIZE)
    every = torch.ones(sweeps.num_pixels, dtype=torch.bool)
    components = find_components(sweeps, ChangedPixels(every, every, every), (1,))
    levels = movable_nodes(sweeps, components, None).kind
    assert bool((levels == NodeKind.CHANGED).any()) == is_node and 0 in levels
