"""Clusters of hand-made images (Alg. clustering). The tests of the methods compare clusters with the oracle."""

from __future__ import annotations

import numpy as np
import torch
from scenes import config as small_config
from scenes import has_kornia_labelling

from cflow_torch.config import Config
from cflow_torch.dense.clustering import Clusters, cluster_images


def config(**overrides) -> Config:
    return small_config(max_extent=1000.0).replace(**overrides)


def found(images: np.ndarray, settings: Config) -> Clusters:
    return cluster_images(torch.from_numpy(images), 0.25, settings)[0]


def draw(*rows: str) -> np.ndarray:
    """One window of two equal sweeps from text; # = occupied."""
    image = np.array([[c == "#" for c in row] for row in rows])
    return np.stack([image, image])[None]


def count(image: np.ndarray, **settings) -> int:
    """Number of clusters, which both engines agree on."""
    engines = ("sparse", "kornia") if has_kornia_labelling() else ("sparse",)
    (number,) = {len(found(image, config(labeling=label, **settings)).window) for label in engines}
    return number


def test_a_gap_of_two_pixels_joins_and_of_three_does_not():
    assert count(draw("#..#")) == 1 and count(draw("#...#")) == 2


def test_only_connectivity_8_joins_corners():
    corner = draw("#....", ".....", ".....", "...#.")
    assert count(corner, connectivity=8) == 1 and count(corner, connectivity=4) == 2


def test_a_component_of_the_largest_extent_is_not_split():
    # Dilated, the component is 11 pixels long: 2.75 m. Oversized, it would fall apart
    # at the gap, where the two dilated parts touch along two pixels only.
    image = draw("." * 13, "..####.......", "........###..", "." * 13)
    assert count(image, max_extent=2.75) == 1
    assert count(image, max_extent=float(np.nextafter(2.75, 0))) == 2


def test_a_cluster_needs_pixels_at_t1_and_before():
    images = np.zeros((1, 3, 5, 30), dtype=bool)
    images[0, 0, 2, [1, 12, 20]] = True  # t+1
    images[0, 1, 2, [6, 12]] = True  # t
    images[0, 2, 2, 22] = True  # t-1: together with the last one of t+1
    clusters, cluster_of_cell = cluster_images(torch.from_numpy(images), 0.25, config())
    assert clusters.first.tolist() == [[2, 12], [2, 20]]
    row = cluster_of_cell[:-1].view(3, 5, 30)[:, 2]
    assert row[0, [1, 12, 20]].tolist() == [2, 0, 1] and row[1, [6, 12]].tolist() == [2, 0] and row[2, 22] == 1
