"""Connected components of sparse images against SciPy: random images, hard shapes, sizes, rounds of union-find."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from kornia import contrib
from scenes import LABELINGS
from scipy import ndimage
from scipy.sparse import coo_matrix, csgraph

from cflow_torch.ops.kornia_engine import connected_components_kornia
from cflow_torch.ops.labeling import connected_components, label_together, pad, union_find
from cflow_torch.types import CFlowError

STRUCTURE = {4: ndimage.generate_binary_structure(2, 1), 8: np.ones((3, 3), dtype=bool)}


def by_scipy(images: np.ndarray, connectivity: int, reach: int) -> np.ndarray:
    """The expected result of `connected_components`, image by image."""
    first = []
    for image in images:
        drawn = ndimage.binary_dilation(image, STRUCTURE[8]) if reach == 3 else image
        labels = ndimage.label(drawn, STRUCTURE[connectivity])[0][image]
        _, position, inverse = np.unique(labels, return_index=True, return_inverse=True)
        first.append(position[inverse.reshape(-1)] + sum(map(len, first)))
    return np.concatenate(first)


def label(images: np.ndarray, connectivity: int, reach: int, engine: str = "sparse") -> np.ndarray:
    occupancy = torch.from_numpy(images)
    pixels = occupancy.flatten().nonzero()[:, 0]
    components = connected_components if engine == "sparse" else connected_components_kornia
    return components(occupancy, pixels, connectivity, reach).numpy()


@pytest.mark.parametrize("engine", LABELINGS)
@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("connectivity", [4, 8])
def test_random_images_equal_scipy(connectivity, reach, engine):
    rng = np.random.default_rng(connectivity + reach)
    for shape in [(1, 1), (1, 17), (19, 1), (2, 2), (23, 40)]:
        images = rng.random((7, *shape)) < np.array([0.0, 0.02, 0.1, 0.2, 0.41, 0.59, 1.0])[:, None, None]
        assert label(images, connectivity, reach, engine).tolist() == by_scipy(images, connectivity, reach).tolist()


@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("connectivity", [4, 8])
def test_images_of_every_size_equal_scipy(connectivity, reach):
    """Blocks and margins fit images of any size. Pixels in the last row and column test every neighbour."""
    rng = np.random.default_rng(connectivity + reach)
    for height, width in [(n, 1 + (5 * n) % 26) for n in range(1, 27)]:
        images = rng.random((3, height, width)) < 0.08
        images[:, -1, rng.random(width) < 0.5] = images[:, rng.random(height) < 0.5, -1] = True
        assert label(images, connectivity, reach).tolist() == by_scipy(images, connectivity, reach).tolist()


def test_without_union_find_kornia_says_what_to_do(monkeypatch):
    monkeypatch.delattr(contrib, "connected_components_union_find", raising=False)
    with pytest.raises(CFlowError, match="kornia >= 0.9.*sparse"):
        label(np.ones((1, 3, 3), dtype=bool), 8, 1, "kornia")


@pytest.mark.parametrize("connectivity", [4, 8])
def test_sets_of_images_that_are_labelled_together_equal_each_set_alone(connectivity):
    """Several sizes and reaches, and an empty set. The components of a set follow those of the set before."""
    rng = np.random.default_rng(connectivity)
    shapes = [((3, 9, 14), 3), ((3, 18, 28), 1), ((1, 5, 5), 1), ((3, 18, 28), 3), ((3, 40, 25), 1)]
    for density in ([0.3, 0.1, 0.0, 0.2, 0.4], [0.0] * 5, [1.0] * 5):
        drawn = [torch.from_numpy(rng.random(shape) < part) for (shape, _), part in zip(shapes, density)]
        sets = [(pad([images]), reach) for images, (_, reach) in zip(drawn, shapes)]
        for some in (sets, sets[:1], sets[2:3], sets[3:]):
            found, before = label_together(some, connectivity), 0
            for (padded, reach), together in zip(some, found):
                window, row, col = padded.nonzero().t()
                row = row + window * padded.shape[1]
                (alone,) = label_together([(padded, reach)], connectivity)
                component, expected = together.of_pixel(row, col), alone.of_pixel(row, col)
                assert together.num_components == found[0].num_components
                assert (component - before).tolist() == expected.tolist()
                assert bool((expected < alone.num_components).all())
                before += alone.num_components
            assert before == found[0].num_components, "the components of all sets are numbered one after the other"


def test_union_find_equals_scipy():
    rng = np.random.default_rng(0)
    for num_nodes, num_edges in [(1, 0), (5, 0), (1, 3), (10, 6), (200, 150), (3000, 9000)]:
        edges = rng.integers(0, num_nodes, (2, num_edges))  # with loops and repeated edges
        root = union_find(num_nodes, *torch.from_numpy(edges)).numpy()
        graph = coo_matrix((np.ones(num_edges), tuple(edges)), shape=(num_nodes, num_nodes))
        _, labels = csgraph.connected_components(graph, directed=False)
        _, first = np.unique(labels, return_index=True)
        assert root.tolist() == first[labels].tolist()


@pytest.mark.parametrize("num_nodes", [17, 65_536])
def test_paths_stars_and_trees_take_few_rounds_whatever_their_numbering(num_nodes, monkeypatch):
    # In every round each root with a smaller neighbour hooks onto the smallest one. A root that stays has no smaller
    # neighbour: after the next round it has hooked as well or swallowed all of its neighbours. So two rounds at least
    # halve the roots of every open component: at most 2 log2(V) + 1 rounds for V nodes.
    rng, line, hook, rounds = np.random.default_rng(0), np.arange(num_nodes), torch.Tensor.scatter_reduce_, []
    monkeypatch.setattr(torch.Tensor, "scatter_reduce_", lambda *given: rounds.append(1) or hook(*given))
    bit_reversed = np.array([int(f"{i:032b}"[::-1], 2) for i in line]).argsort().argsort()
    for sources, targets in (
        (line[:-1], line[1:]),
        (line[:-1], line[1:] * 0 + num_nodes - 1),
        ((line[1:] - 1) // 2, line[1:]),
    ):
        for numbering in (line, line[::-1].copy(), rng.permutation(num_nodes), bit_reversed):
            rounds.clear()
            root = union_find(num_nodes, *map(torch.from_numpy, (numbering[sources], numbering[targets])))
            assert not root.any() and 1 <= len(rounds) <= 2 * math.ceil(math.log2(num_nodes)) + 1
