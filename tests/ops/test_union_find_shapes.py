"""Components of shapes that union-find finds hard: right, and in few rounds whatever their size.

In every round each root with a smaller neighbour hooks onto the smallest one. A root that stays has no smaller
neighbour: after the next round it has either hooked as well or swallowed all of its neighbours. So two rounds at least
halve the roots of every open component, and there are at most 2 log2(V) + 1 rounds for V nodes, each with at most
log2(V) + 1 looks whether all trees are flat. Table of what was needed:

  python tests/test_union_find_shapes.py
"""

from __future__ import annotations

import math
import time
from typing import Callable, Dict, List, NamedTuple, Tuple

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch.utils._python_dispatch import TorchDispatchMode

from cflow_torch.ops.labeling import connected_components, union_find

STRUCTURE = {4: ndimage.generate_binary_structure(2, 1), 8: np.ones((3, 3), dtype=bool)}


def spiral(size: int) -> np.ndarray:
    """One arm, one pixel wide, that winds inwards; a free pixel between its turns."""
    image = np.zeros((size, size), dtype=bool)
    low, high = 0, size - 1
    image[0, 0] = True
    while low <= high:
        image[low, max(low - 1, 0) : high + 1] = image[low : high + 1, high] = image[high, low : high + 1] = True
        image[low + 2 : high + 1, low] = True
        low, high = low + 2, high - 2
    return image


def comb(size: int) -> np.ndarray:
    """Teeth that meet in the last row only."""
    image = np.zeros((size, size), dtype=bool)
    image[:, ::2] = image[-1] = True
    return image


def combs_in_combs(size: int) -> np.ndarray:
    """Teeth that join in pairs, pairs of them in pairs, ... row by row from the top, and all of them in the last."""
    image = np.zeros((size, size), dtype=bool)
    image[:, ::2] = image[-1] = True
    step = 2
    while step < size:
        row = size - size // step
        for left in range(0, size - step, 2 * step):
            image[row, left : left + step + 1] = True
        step *= 2
    return image


def frames(size: int) -> np.ndarray:
    """Squares within squares that do not touch."""
    row, col = np.mgrid[0:size, 0:size]
    ring = np.minimum(np.minimum(row, col), size - 1 - np.maximum(row, col))
    return ring % 2 == 0


def diagonals(size: int) -> np.ndarray:
    """Chains from corner to corner, which touch at corners only."""
    row, col = np.mgrid[0:size, 0:size]
    return (row + col) % 4 == 0


def checkerboard(size: int) -> np.ndarray:
    """Corner to corner everywhere."""
    row, col = np.mgrid[0:size, 0:size]
    return (row + col) % 2 == 0


def serpentine(size: int) -> np.ndarray:
    """Rows joined alternately at the right and at the left."""
    image = np.zeros((size, size), dtype=bool)
    image[::2] = True
    image[1::4, -1] = image[3::4, 0] = True
    return image


def hilbert(size: int) -> np.ndarray:
    """Hilbert's curve of the largest order that fits, a pixel wide."""
    order = int(math.log2((size + 1) / 2))
    side = 1 << order
    index = np.arange(side * side)
    x, y, rest, scale = np.zeros_like(index), np.zeros_like(index), index.copy(), 1
    while scale < side:
        right, up = 1 & (rest // 2), 1 & (rest ^ (rest // 2))
        flip = (up == 0) & (right == 1)
        x, y = np.where(flip, scale - 1 - x, x), np.where(flip, scale - 1 - y, y)
        x, y = np.where(up == 0, y, x), np.where(up == 0, x, y)
        x, y, rest, scale = x + scale * right, y + scale * up, rest // 4, scale * 2
    image = np.zeros((size, size), dtype=bool)
    image[2 * y, 2 * x] = True
    image[y[:-1] + y[1:], x[:-1] + x[1:]] = True
    return image


def percolation(share: float) -> Callable[[int], np.ndarray]:
    """Pixels set at random. At 0.593 of 4-connected ones, and at 0.407 of 8-connected, clusters have every size."""

    def image(size: int) -> np.ndarray:
        return np.random.default_rng(0).random((size, size)) < share

    return image


def full(size: int) -> np.ndarray:
    return np.ones((size, size), dtype=bool)


SHAPES: Dict[str, Callable[[int], np.ndarray]] = {
    "spiral": spiral,
    "comb": comb,
    "combs in combs": combs_in_combs,
    "nested frames": frames,
    "diagonal chains": diagonals,
    "checkerboard": checkerboard,
    "serpentine snake": serpentine,
    "Hilbert curve": hilbert,
    "random, 40.7 %": percolation(0.407),
    "random, 59.3 %": percolation(0.593),
    "full": full,
}


class Rounds(NamedTuple):
    """What union-find did: rounds of hooking, and looks whether anything still moves, of all rounds together."""

    rounds: int
    looks: int


class Counted(TorchDispatchMode):
    """Counts the operations that a round and a look have one of each."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: Dict[str, int] = {}

    def __torch_dispatch__(self, function, types, arguments=(), named=None):  # noqa: ANN001, ANN204
        name = function._schema.name.split("::")[1]
        self.calls[name] = self.calls.get(name, 0) + 1
        return function(*arguments, **(named or {}))


def counted_union_find(num_nodes: int, sources: torch.Tensor, targets: torch.Tensor) -> Tuple[torch.Tensor, Rounds]:
    with Counted() as counted:
        root = union_find(num_nodes, sources, targets)
    return root, Rounds(counted.calls.get("scatter_reduce_", 0), counted.calls.get("equal", 0))


def label(images: np.ndarray, connectivity: int, reach: int, monkeypatch) -> Tuple[np.ndarray, Rounds, int]:
    """Position of the first pixel of each pixel's component, what it took, and the number of nodes."""
    seen: List[Tuple[Rounds, int]] = []

    def find(num_nodes, sources, targets):  # noqa: ANN001, ANN202
        root, rounds = counted_union_find(num_nodes, sources, targets)
        seen.append((rounds, num_nodes))
        return root

    monkeypatch.setattr("cflow_torch.ops.labeling.union_find", find)
    occupancy = torch.from_numpy(images)
    found = connected_components(occupancy, occupancy.flatten().nonzero()[:, 0], connectivity, reach).numpy()
    return found, *seen[0]


def by_scipy(images: np.ndarray, connectivity: int, reach: int) -> np.ndarray:
    """The same by SciPy, image by image."""
    found, before = [], 0
    for image in images:
        drawn = ndimage.binary_dilation(image, STRUCTURE[8]) if reach == 3 else image
        labels = ndimage.label(drawn, STRUCTURE[connectivity])[0][image]
        _, position, inverse = np.unique(labels, return_index=True, return_inverse=True)
        found.append(position[inverse.reshape(-1)] + before)
        before += labels.size
    return np.concatenate(found)


def most_rounds(num_nodes: int) -> int:
    return 2 * max(1, math.ceil(math.log2(max(num_nodes, 2)))) + 1


def assert_few(rounds: Rounds, num_nodes: int) -> None:
    assert rounds.rounds <= most_rounds(num_nodes)
    assert rounds.looks <= rounds.rounds * (math.ceil(math.log2(max(num_nodes, 2))) + 1)


@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("shape", SHAPES)
def test_hard_shapes_equal_scipy_in_few_rounds(shape, connectivity, reach, monkeypatch):
    """Alone, turned and mirrored, and all of those as one batch, in as many rounds as the hardest."""
    image = SHAPES[shape](127)
    images = np.stack([image, image[::-1], image[:, ::-1].T, image.T, np.zeros_like(image)])
    expected = by_scipy(images, connectivity, reach)
    found, together, num_nodes = label(images, connectivity, reach, monkeypatch)
    assert found.tolist() == expected.tolist()
    assert_few(together, num_nodes)
    alone = [label(one[None], connectivity, reach, monkeypatch) for one in images]
    assert together.rounds == max(rounds.rounds for _, rounds, _ in alone)
    assert np.concatenate([one[0] for one in alone]).size == expected.size


@pytest.mark.parametrize("shape", SHAPES)
def test_rounds_hardly_grow_with_the_size(shape, monkeypatch):
    """From 63 to 511 pixels a side, 66 times as many: no more than four more rounds."""
    few, many = (label(SHAPES[shape](size)[None], 4, 1, monkeypatch)[1].rounds for size in (63, 511))
    assert many <= few + 4


def test_snakes_of_a_million_pixels(monkeypatch):
    for shape, size in (("serpentine snake", 1415), ("spiral", 1415), ("Hilbert curve", 2047)):
        image = SHAPES[shape](size)
        assert image.sum() > 10**6
        found, rounds, num_nodes = label(image[None], 4, 1, monkeypatch)
        assert ndimage.label(image, STRUCTURE[4])[1] == 1 and not found.any(), shape
        assert num_nodes == image.sum()
        assert_few(rounds, num_nodes)


def test_graphs_of_any_numbering_take_few_rounds():
    """Paths and trees whose nodes are numbered at random or against them; stars whose middle is last."""
    rng = np.random.default_rng(0)
    for num_nodes in (2, 3, 17, 1000, 65_536):
        line = np.arange(num_nodes)
        bits = np.array([int(f"{i:032b}"[::-1], 2) for i in line]).argsort().argsort()  # bit-reversed
        star = np.full(num_nodes - 1, num_nodes - 1)
        tree = (line[1:] - 1) // 2
        graphs = [(line[:-1], line[1:]), (line[:-1], star), (tree, line[1:])]
        for sources, targets in graphs:
            for numbering in (line, line[::-1].copy(), rng.permutation(num_nodes), bits):
                ends = torch.from_numpy(numbering[sources]), torch.from_numpy(numbering[targets])
                root, rounds = counted_union_find(num_nodes, *ends)
                assert not root.any()
                assert_few(rounds, num_nodes)


def test_the_worst_graphs_that_a_search_finds_stay_below_the_bound():
    """Small random graphs in all numberings: the most rounds seen for their number of nodes."""
    rng = np.random.default_rng(1)
    most = 0
    for _ in range(500):
        num_nodes = int(rng.integers(2, 40))
        edges = torch.from_numpy(rng.integers(0, num_nodes, (2, int(rng.integers(1, 2 * num_nodes)))))
        _, rounds = counted_union_find(num_nodes, *edges)
        assert_few(rounds, num_nodes)
        most = max(most, rounds.rounds)
    assert most >= 3  # the search found more than the trivial


def measured(image: np.ndarray, connectivity: int) -> Tuple[int, Rounds, int, float, float]:
    """Components, what they took, nodes, milliseconds of `connected_components` (median of three) and of SciPy."""
    occupancy, times = torch.from_numpy(image[None]), []
    pixels = occupancy.flatten().nonzero()[:, 0]
    for _ in range(3):
        start = time.perf_counter()
        found = connected_components(occupancy, pixels, connectivity, 1)
        times.append(1000 * (time.perf_counter() - start))
    start = time.perf_counter()
    _, number = ndimage.label(image, STRUCTURE[connectivity])
    of_scipy = 1000 * (time.perf_counter() - start)
    assert len(found.unique()) == number
    patch = pytest.MonkeyPatch()
    _, rounds, num_nodes = label(image[None], connectivity, 1, patch)
    patch.undo()
    return number, rounds, num_nodes, sorted(times)[1], of_scipy


def main() -> None:
    """Markdown: each shape 1415 pixels a side (Hilbert's curve 2047), and its rounds at 255; connectivity 4 / 8."""
    print("| shape | pixels | components | rounds at 255 | rounds | at most | ms | SciPy, ms |\n" + "|---" * 8 + "|")
    for name, shape in SHAPES.items():
        image = shape(2047 if shape is hilbert else 1415)
        few, many = ([measured(of_size, c) for c in (4, 8)] for of_size in (shape(255), image))
        cells = (
            [number for number, *_ in many],
            [rounds.rounds for _, rounds, *_ in few],
            [rounds.rounds for _, rounds, *_ in many],
            [most_rounds(num_nodes) for _, _, num_nodes, *_ in many],
            [round(own) for *_, own, _ in many],
            [round(of_scipy) for *_, of_scipy in many],
        )
        print(f"| {name} | {int(image.sum()):,} | " + " | ".join(f"{a:,} / {b:,}" for a, b in cells) + " |")


if __name__ == "__main__":
    main()
