"""From sparse to dense: the oracle's shifts on random images, medians and nearest matches by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracle.clustering import cluster, connected_components
from oracle.keypoints import median_of_components, nearest_match
from oracle.matching import Match
from scenes import LABELINGS, config

from cflow_torch.keypoints.densify import densify
from cflow_torch.keypoints.matching import Matches


def oracle_shifts(image: np.ndarray, matches: list, settings):
    """(H, W) group of each pixel, and (dx, dy, score) of each group."""
    if settings.densify == "nearest":
        return nearest_match(image, matches)
    if settings.densify == "clusters":
        ids = cluster([image, image], 0.25, settings.max_extent, settings.connectivity)
    else:
        ids = connected_components(image, settings.connectivity)[0] - 1
    return ids, median_of_components(ids, matches)


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("way", ["components", "clusters", "nearest"])
def test_shifts_equal_the_oracle(way, labeling):
    rng = np.random.default_rng(0)
    for connectivity in (4, 8):
        settings = config("keypoints", densify=way, labeling=labeling, connectivity=connectivity, max_extent=3.0)
        images = rng.random((3, 20, 30)) < 0.07
        matched = images & (rng.random(images.shape) < 0.5)
        matched[1] = False
        place = np.flatnonzero(matched)
        shift, score = rng.integers(-3, 4, (len(place), 2)), rng.random(len(place))
        found = densify(
            torch.from_numpy(images),
            torch.from_numpy(place),
            Matches(torch.arange(len(place)), torch.from_numpy(shift), torch.from_numpy(score)),
            0.25,
            settings,
        )
        assert found.pixel.tolist() == np.flatnonzero(images).tolist()
        of_window = np.nonzero(matched)[0]
        for window, image in enumerate(images):
            rows, cols = np.nonzero(matched[window])
            mine = of_window == window
            values = zip(rows.tolist(), cols.tolist(), shift[mine].tolist(), score[mine].tolist())
            ids, shifts = oracle_shifts(image, [Match(r, c, dx, dy, s) for r, c, (dy, dx), s in values], settings)
            groups = found.group[found.pixel // image.size == window]
            for group, number in zip(groups.tolist(), ids[image].tolist()):
                if number < 0:
                    assert group == len(found.shift)
                    continue
                assert int(found.number[group]) == number
                dy, dx = found.shift[group].tolist()
                assert (dx, dy, float(found.score[group])) == pytest.approx(shifts[number])


def image_of(pixels, shape=(8, 8)) -> np.ndarray:
    image = np.zeros(shape, dtype=bool)
    for pixel in pixels:
        image[pixel] = True
    return image


def test_medians_by_hand():
    image = image_of([(0, 0), (0, 1), (1, 2), (4, 4), (6, 0), (6, 1)])
    matches = [Match(0, 0, 1, -1, 0.5), Match(0, 1, 4, 1, 1.0), Match(6, 0, 7, 1, 0.25), Match(6, 1, 2, 6, 0.75)]
    ids = connected_components(image, 8)[0] - 1
    assert ids[image].tolist() == [0, 0, 0, 1, 2, 2]
    # (4, 4) without a match keeps its number.
    assert median_of_components(ids, matches) == [(2.5, 0.0, 0.75), (0.0, 0.0, 0.0), (4.5, 3.5, 0.5)]
    shifts = median_of_components(ids, [*matches, Match(1, 2, 9, 9, 0.875)])
    assert shifts[0] == (4, 1, 0.875)  # odd: the middle of each


def test_nearest_matches_by_hand():
    image = image_of([(2, 2), (2, 4), (2, 5), (2, 6), (4, 4)])
    ids, shifts = nearest_match(image, [Match(2, 2, 1, 0, 0.5), Match(2, 6, 2, 0, 0.75)])
    assert ids[image].tolist() == [0, 0, 1, 1, 0]  # (2, 4) and (4, 4) are equally near: smallest column
    assert shifts == [(1, 0, 0.5), (2, 0, 0.75)]
    ids, shifts = nearest_match(image, [])
    assert (ids == -1).all() and shifts == []
