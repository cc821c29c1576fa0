"""Clusters (Alg. clustering): the oracle's on random images, known ones by hand."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch
from oracle.clustering import cluster as oracle_cluster
from oracle.pixels import bounding_box
from scenes import LABELINGS, has_kornia_labelling
from scenes import config as small_config

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters, cluster_images


def config(**overrides) -> Config:
    return small_config(max_extent=1000.0).replace(**overrides)


def found(images: np.ndarray, settings: Config) -> Clusters:
    return cluster_images(torch.from_numpy(images), 0.25, settings)[0]


def assert_equals_oracle(images: np.ndarray, settings: Config, reach: int) -> int:
    """Every field, window by window; returns the number of clusters."""
    clusters, columns = cluster_images(torch.from_numpy(images), 0.25, settings, reach)
    num_windows, _, height, width = images.shape
    number = np.full((num_windows, height * width), -2)
    number[columns.window, columns.pixel] = columns.cluster
    pixels, start = [], 0
    for window, steps in enumerate(images):
        expected = oracle_cluster(list(steps), 0.25, settings.max_extent, settings.connectivity, reach)
        count, occupied = int(expected.max(initial=-1)) + 1, steps.any(0)
        theirs = np.where(expected < 0, len(clusters.window), expected + start)
        assert number[window].reshape(height, width)[occupied].tolist() == theirs[occupied].tolist()
        for step, image in enumerate(steps):
            pixels += [(start + expected[r, c], step, r, c) for r, c in np.argwhere(image) if expected[r, c] >= 0]
        for i in range(count):
            box = bounding_box([np.argwhere((expected == i) & occupied)])
            assert [*clusters.first[start + i].tolist(), *clusters.size[start + i].tolist()] == list(box)
        assert clusters.window[start : start + count].tolist() == [window] * count
        assert clusters.id_in_window()[start : start + count].tolist() == list(range(count))
        start += count
    assert len(clusters.window) == start
    columns_of_pixels = [getattr(clusters.pixels, f.name).tolist() for f in fields(clusters.pixels)]
    assert sorted(zip(*columns_of_pixels)) == sorted(pixels)
    return start


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("max_extent, reach", [(1000.0, 3), (3.0, 3), (1.0, 3), (1.0, 1)])
def test_clusters_equal_the_oracle(max_extent, reach, labeling):
    rng, total = np.random.default_rng(int(max_extent)), 0
    for i, shape in enumerate([(1, 2, 1, 1), (2, 3, 24, 1), (3, 2, 20, 25), (2, 4, 33, 31)]):
        for density in (0.0, 0.01, 0.06, 0.15, 1.0):
            settings = config(max_extent=max_extent, connectivity=(4, 8)[i % 2], labeling=labeling)
            total += assert_equals_oracle(rng.random(shape) < density, settings, reach)
    assert total > 15


def drawing(*rows: str) -> np.ndarray:
    """One window of two equal sweeps from text; # = occupied."""
    image = np.array([[c == "#" for c in row] for row in rows])
    return np.stack([image, image])[None]


def count(image: np.ndarray, **settings) -> int:
    """Clusters, by both engines if there are two."""
    engines = ("sparse", "kornia") if has_kornia_labelling() else ("sparse",)
    numbers = {len(found(image, config(labeling=label, **settings)).window) for label in engines}
    assert len(numbers) == 1
    return numbers.pop()


def test_a_gap_of_two_pixels_joins_and_of_three_does_not():
    assert count(drawing("#..#")) == 1 and count(drawing("#...#")) == 2


def test_connectivity_matters_at_the_corners():
    corner = drawing("#....", ".....", ".....", "...#.")
    assert count(corner, connectivity=8) == 1 and count(corner, connectivity=4) == 2


def test_a_cluster_needs_pixels_at_t1_and_before():
    images = np.zeros((1, 3, 5, 30), dtype=bool)
    images[0, 0, 2, [1, 12, 20]] = True  # t+1
    images[0, 1, 2, [6, 12]] = True  # t
    images[0, 2, 2, 22] = True  # t-1: together with the last one of t+1
    clusters, columns = cluster_images(torch.from_numpy(images), 0.25, config())
    assert clusters.first.tolist() == [[2, 12], [2, 20]]
    assert dict(zip((columns.pixel - 60).tolist(), columns.cluster.tolist())) == {1: 2, 6: 2, 12: 0, 20: 1, 22: 1}
