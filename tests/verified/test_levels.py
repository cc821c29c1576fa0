"""Levels of components and what holds what: the reference's on random images, known ones by hand."""

from __future__ import annotations

import math

import numpy as np
import oracle as ref
import pytest
import torch
from scenes import LABELINGS, needs_gpu, same_bits

from cflow_torch.config import Config
from cflow_torch.verified.height_slices import Cells, cells_of_image
from cflow_torch.verified.levels import equals_parent, make_level, parents
from cflow_torch.windows.bev_grid import Grid


def config(**overrides) -> Config:
    return Config(pixel_sizes=(0.25,), max_extent=5.0).replace(**overrides)


def as_cells(images: np.ndarray) -> Cells:
    """(B, S, H, W) uint8 -> cells of 0.25 m."""
    num_windows, num_steps, height, width = images.shape
    grid = Grid(0.25, (0.0, 0.0, -1.0), (0.25 * width - 0.1, 0.25 * height - 0.1, 1.0))
    assert (grid.height, grid.width) == (height, width)
    return cells_of_image(torch.from_numpy(np.append(images.ravel(), np.uint8(0))), grid, num_windows, num_steps)


def random_images(rng: np.random.Generator, shape, density: float) -> np.ndarray:
    return (rng.integers(1, 16, shape) * (rng.random(shape) < density)).astype(np.uint8)


def assert_equals_reference(images: np.ndarray, block: int, reach: int, max_object: float, settings: Config) -> int:
    """All fields that are not `cluster`'s own, window by window; returns the number of components."""
    cells = as_cells(images)
    level = make_level(cells, block, reach, max_object, settings)
    assert level.block == block and level.image[-1] == 0
    drawn = level.image[:-1].view(*images.shape[:2], level.height, level.width).numpy()
    number = np.full(images.size, -2)
    number[cells.pixel.numpy()] = level.node.numpy()
    number = number.reshape(images.shape)
    start, num_components = 0, len(level.clusters.window)
    for window, steps in enumerate(images):
        expected = ref.components_at(list(steps), block, reach, 0.25, max_object, settings)
        assert np.array_equal(drawn[window], np.stack(expected.images))
        count = len(expected.too_long)
        for m, image in enumerate(steps):
            theirs = expected.node[m][image > 0]
            assert (
                np.where(theirs < 0, num_components, theirs + start).tolist() == number[window, m][image > 0].tolist()
            )
        assert level.too_long[start : start + count].tolist() == expected.too_long
        start += count
    assert start == num_components
    return start


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("reach", [1, 3])
@pytest.mark.parametrize("block", [1, 2, 3, 4])
def test_levels_equal_the_reference(block, reach, connectivity, labeling):
    rng = np.random.default_rng(block + 10 * reach)
    settings = config(connectivity=connectivity, labeling=labeling)
    total = 0
    for shape in [(1, 2, 1, 1), (2, 3, 23, 1), (3, 2, 20, 25), (2, 4, 33, 30)]:
        for density in (0.0, 0.01, 0.05, 0.15, 1.0):
            total += assert_equals_reference(random_images(rng, shape, density), block, reach, 1.3, settings)
    assert total > 20


def test_exactly_the_largest_object_is_not_too_long():
    images = np.zeros((2, 2, 9, 30), dtype=np.uint8)
    images[0, 0, 4, 3:11] = images[1, 0, 1:8, 5] = 1  # t+1: 8 pixels = 2 m, 7 pixels
    images[:, 1, 4, 2:29] = 1  # t is longer
    for max_object, too_long in ((2.0, [False, False]), (1.9, [True, False]), (0.25, [True, True])):
        assert make_level(as_cells(images), 1, 3, max_object, config(max_extent=99.0)).too_long.tolist() == too_long
    assert make_level(as_cells(images), 4, 3, 2.0, config(max_extent=99.0)).too_long.tolist() == [False, False]
    assert not make_level(as_cells(images), 1, 3, math.inf, config(max_extent=99.0)).too_long.any()


def test_plain_components_neither_join_over_gaps_nor_split():
    images = np.zeros((1, 2, 3, 40), dtype=np.uint8)
    images[0, :, 1, :30] = images[0, :, 1, 31:33] = 1  # 7.5 m long, longer than max_extent
    assert len(make_level(as_cells(images), 1, 1, math.inf, config()).clusters.window) == 2
    assert len(make_level(as_cells(images), 1, 3, math.inf, config()).clusters.window) == 1


def random_labels(rng: np.random.Generator, num_pixels: int, most: int) -> np.ndarray:
    """(P,) numbers 0 ... M-1, each at least once, and -1."""
    labels = rng.integers(-1, most, num_pixels)
    used = np.unique(labels[labels >= 0])
    return np.where(labels < 0, -1, np.searchsorted(used, labels))


def as_nodes(labels: np.ndarray):
    count = int(labels.max(initial=-1)) + 1
    return torch.from_numpy(np.where(labels < 0, count, labels)), count


@pytest.mark.parametrize("seed", range(30))
def test_parents_equal_the_reference(seed):
    rng = np.random.default_rng(seed)
    num_pixels = int(rng.integers(0, 60))
    above = random_labels(rng, num_pixels, int(rng.integers(1, 12)))
    below = random_labels(rng, num_pixels, int(rng.integers(1, 40)))
    if seed % 2:  # nested: the parts of what lies above; some are all of it
        below = np.where((below % 3 == 0) & (above >= 0) & (above % 2 == 0), -1, above * 2 + (above % 2) * (below % 2))
        below = np.searchsorted(np.unique(below[below >= 0]), below) * (below >= 0) - (below < 0)
    (node, num_nodes), (held_by, num_above) = as_nodes(below), as_nodes(above)
    ours = parents(node, num_nodes, held_by, num_above)
    assert torch.where(ours < num_above, ours, -1).tolist() == ref.parents(below.tolist(), above.tolist())
    equal = equals_parent(node, num_nodes, held_by, num_above, ours)
    assert equal.tolist() == ref.equals_parent(below.tolist(), above.tolist())


def test_parents_by_hand():
    above = torch.tensor([2, 0, 0, 0, 1, 1, 2])  # 2 = none
    below = torch.tensor([0, 0, 0, 4, 1, 2, 3])  # 4 = none
    held_by = parents(below, 4, above, 2)
    assert held_by.tolist() == [0, 1, 1, 2]
    assert equals_parent(below, 4, above, 2, held_by).tolist() == [False] * 4
    same = torch.tensor([4, 0, 0, 0, 1, 2, 3])
    assert equals_parent(same, 4, above, 2, parents(same, 4, above, 2)).tolist() == [True, False, False, False]


def test_components_of_real_levels_are_held():
    rng = np.random.default_rng(2)
    cells = as_cells(random_images(rng, (3, 3, 40, 40), 0.04))
    levels = [make_level(cells, *kind, math.inf, config(max_extent=99.0)) for kind in ((4, 3), (2, 3), (1, 3), (1, 1))]
    for above, level in zip(levels, levels[1:]):
        counts = len(level.clusters.window), len(above.clusters.window)
        held_by = parents(level.node, counts[0], above.node, counts[1])
        inside = level.node < counts[0]
        assert inside.any() and torch.equal(held_by[level.node[inside]], above.node[inside])
        assert torch.equal(above.clusters.window[held_by], level.clusters.window)


@pytest.mark.cuda
@needs_gpu
def test_on_cuda_as_on_cpu():
    images = random_images(np.random.default_rng(3), (3, 3, 50, 61), 0.05)
    cells = as_cells(images)
    lists = (cells.image, cells.pixel, cells.window, cells.step, cells.row, cells.col, cells.slices)
    on_gpu = Cells(cells.grid, cells.num_windows, cells.num_steps, *(values.cuda() for values in lists))
    coarse = []
    for kind in ((4, 3), (1, 1)):
        cpu, gpu = make_level(cells, *kind, 2.0, config()), make_level(on_gpu, *kind, 2.0, config())
        for name in ("image", "node", "too_long"):
            assert same_bits(getattr(gpu, name), getattr(cpu, name))
        coarse.append((cpu, gpu))
    (above, above_gpu), (level, level_gpu) = coarse
    sizes = len(level.too_long), len(above.too_long)
    held_by = parents(level.node, sizes[0], above.node, sizes[1])
    assert same_bits(parents(level_gpu.node, sizes[0], above_gpu.node, sizes[1]), held_by)
