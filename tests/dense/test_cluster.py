"""Clusters (Alg. clustering): the reference's on random images, known ones by hand."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import oracle as ref
import pytest
import torch
from scenes import LABELINGS, needs_gpu

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters, cluster


def config(**overrides) -> Config:
    return Config(pixel_sizes=(0.25,), max_extent=1000.0).replace(**overrides)


def found(images: np.ndarray, settings: Config) -> Clusters:
    return cluster(torch.from_numpy(images), 0.25, settings)[0]


def assert_equals_reference(images: np.ndarray, settings: Config, pixel_size: float = 0.25) -> int:
    """Every field, window by window; returns the number of clusters."""
    num_windows, num_steps, height, width = images.shape
    clusters, of_pixel = cluster(torch.from_numpy(images), pixel_size, settings)
    number = of_pixel[:-1].view(images.shape).numpy()
    pixels, start = [], 0
    for window, steps in enumerate(images):
        expected = ref.cluster(list(steps), pixel_size, settings.max_extent, settings.connectivity)
        count = int(expected.max(initial=-1)) + 1
        for step, image in enumerate(steps):
            ours = number[window, step][image]
            theirs = expected[image]
            assert np.where(theirs < 0, len(clusters.window), theirs + start).tolist() == ours.tolist()
            pixels += [(start + expected[r, c], step, r, c) for r, c in np.argwhere(image) if expected[r, c] >= 0]
        for i in range(count):
            members = np.argwhere((expected == i) & steps.any(0))
            row, col, box_height, box_width = ref.bounding_box([members])
            assert clusters.first[start + i].tolist() == [row, col]
            assert clusters.size[start + i].tolist() == [box_height, box_width]
        assert clusters.window[start : start + count].tolist() == [window] * count
        assert clusters.id_in_window()[start : start + count].tolist() == list(range(count))
        start += count
    assert len(clusters.window) == start
    assert of_pixel[-1] == start  # points that are nowhere
    columns = [getattr(clusters.pixels, f.name).tolist() for f in fields(clusters.pixels)]
    assert sorted(zip(*columns)) == sorted(pixels)
    return start


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("connectivity", [4, 8])
@pytest.mark.parametrize("max_extent", [1000.0, 3.0, 1.0])
def test_clusters_equal_the_reference(max_extent, connectivity, labeling):
    rng = np.random.default_rng(int(max_extent) + connectivity)
    settings = config(max_extent=max_extent, connectivity=connectivity, labeling=labeling)
    total = 0
    for shape in [(1, 2, 1, 1), (2, 2, 1, 30), (2, 3, 24, 1), (3, 2, 20, 25), (4, 4, 33, 31)]:
        for density in (0.0, 0.01, 0.03, 0.06, 0.15, 1.0):
            total += assert_equals_reference(rng.random(shape) < density, settings)
    assert total > 50


def drawing(*rows: str) -> np.ndarray:
    """One window of two equal sweeps from text; # = occupied."""
    image = np.array([[c == "#" for c in row] for row in rows])
    return np.stack([image, image])[None]


@pytest.mark.parametrize("labeling", LABELINGS)
def test_a_gap_of_two_pixels_joins_and_of_three_does_not(labeling):
    settings = config(labeling=labeling)
    assert len(found(drawing("#..#"), settings).window) == 1
    assert len(found(drawing("#...#"), settings).window) == 2


@pytest.mark.parametrize("labeling", LABELINGS)
def test_connectivity_matters_at_the_corners(labeling):
    corner = drawing("#....", ".....", ".....", "...#.")
    assert len(found(corner, config(connectivity=8, labeling=labeling)).window) == 1
    assert len(found(corner, config(connectivity=4, labeling=labeling)).window) == 2


@pytest.mark.parametrize("labeling", LABELINGS)
def test_exactly_the_largest_extent_is_not_oversized(labeling):
    # Dilated, the component is 11 pixels long: 2.75 m. Oversized, it would fall apart
    # at the gap, where the two dilated parts touch along two pixels only.
    image = drawing("." * 13, "..####.......", "........###..", "." * 13)
    assert len(found(image, config(max_extent=2.75, labeling=labeling)).window) == 1
    assert len(found(image, config(max_extent=np.nextafter(2.75, 0), labeling=labeling)).window) == 2


@pytest.mark.parametrize("labeling", LABELINGS)
def test_the_border_cuts_the_dilated_box(labeling):
    # The same at the left border: 10 pixels, 2.5 m.
    image = drawing("." * 13, "####.........", "......###....", "." * 13)
    assert len(found(image, config(max_extent=2.5, labeling=labeling)).window) == 1
    assert len(found(image, config(max_extent=2.4, labeling=labeling)).window) == 2


@pytest.mark.parametrize("labeling", LABELINGS)
def test_at_the_border_erosion_ignores_what_lies_outside(labeling):
    # The same two parts in the first rows: they touch along two pixels, which is all that fits into the image.
    image = drawing("####.......", "......###..", "." * 11)
    assert len(found(image, config(max_extent=0.5, labeling=labeling)).window) == 1


@pytest.mark.parametrize("labeling", LABELINGS)
def test_only_oversized_components_are_split(labeling):
    split_me = ("#####............", ".......#####.....", "..............###")
    image = drawing("##...............", "....##...........", *["." * 17] * 3, *split_me, "." * 17)
    clusters = found(image, config(max_extent=3.0, labeling=labeling))
    assert clusters.size.tolist() == [[2, 6], [1, 5], [1, 5], [1, 3]]


@pytest.mark.parametrize("labeling", LABELINGS)
def test_a_cluster_needs_pixels_at_t1_and_before(labeling):
    images = np.zeros((1, 3, 5, 30), dtype=bool)
    images[0, 0, 2, [1, 12, 20]] = True  # t+1
    images[0, 1, 2, [6, 12]] = True  # t
    images[0, 2, 2, 22] = True  # t-1: together with the last one of t+1
    clusters, of_pixel = cluster(torch.from_numpy(images), 0.25, config(labeling=labeling))
    assert clusters.first.tolist() == [[2, 12], [2, 20]]
    assert of_pixel[:-1].view(images.shape)[0, 0, 2, 1] == 2  # none
    assert of_pixel[:-1].view(images.shape)[0, 1, 2, 6] == 2


@pytest.mark.parametrize("labeling", LABELINGS)
def test_windows_do_not_join(labeling):
    images = np.ones((6, 2, 4, 5), dtype=bool)
    clusters = found(images, config(labeling=labeling))
    assert clusters.window.tolist() == list(range(6))
    assert clusters.id_in_window().tolist() == [0] * 6
    alone = found(images, config(labeling=labeling, max_extent=0.5))  # oversized: eroded as one, stays whole
    assert alone.window.tolist() == list(range(6))


def test_large_component_of_many_windows_splits_alone():
    rng = np.random.default_rng(8)
    images = rng.random((5, 2, 40, 40)) < 0.05
    settings = config(max_extent=4.0)
    together = found(images, settings)
    apart = [found(images[i : i + 1], settings) for i in range(5)]
    assert together.first.tolist() == [f for c in apart for f in c.first.tolist()]
    assert together.size.tolist() == [s for c in apart for s in c.size.tolist()]


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("labeling", LABELINGS)
def test_clusters_on_cuda_equal_cpu(labeling):
    images = torch.from_numpy(np.random.default_rng(3).random((3, 3, 50, 60)) < 0.06)
    settings = config(max_extent=4.0, labeling=labeling)
    (on_gpu, _), (on_cpu, _) = cluster(images.cuda(), 0.25, settings), cluster(images, 0.25, settings)
    for name in ("window", "first", "size"):
        assert torch.equal(getattr(on_gpu, name).cpu(), getattr(on_cpu, name))
    for field in fields(on_cpu.pixels):
        assert torch.equal(getattr(on_gpu.pixels, field.name).cpu(), getattr(on_cpu.pixels, field.name))
