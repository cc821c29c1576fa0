"""The oracle itself against SciPy and OpenCV on random images, and by hand.

Whole windows whose answer is known are in tests/dense, tests/keypoints and tests/verified, where method and oracle must
both give it.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Iterator

import cv2
import numpy as np
import pytest
from scenes import config
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components as graph_components

from oracle.clustering import cluster, connected_components, dilate, erode
from oracle.dense import ncc_map, overlap_and_energy, scene_flow_in_1view
from oracle.pixels import bev_dims, in_range, project_bev

SQUARE = np.ones((3, 3), dtype=bool)
STRUCTURE = {4: ndimage.generate_binary_structure(2, 1), 8: SQUARE}


def image_of(pixels, shape) -> np.ndarray:
    image = np.zeros(shape, dtype=bool)
    for r, c in pixels:
        image[r, c] = True
    return image


def same_partition(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two lists of labels group the same things together."""
    pairs = set(zip(a.tolist(), b.tolist()))
    return len(pairs) == len({p[0] for p in pairs}) == len({p[1] for p in pairs})


def random_images() -> Iterator[np.ndarray]:
    rng = np.random.default_rng(7)
    for _ in range(12):
        yield rng.random(tuple(rng.integers(1, 40, 2))) < rng.choice([0.02, 0.08, 0.2, 0.5])


def test_pixels_and_dimensions():
    settings = config(point_cloud_range=(-35.0, -10.0, -1.0, 35.0, 10.0, 2.0))
    assert bev_dims(settings, 0.5) == (41, 141)
    assert bev_dims(settings, 0.3) == (67, 234)  # 66.67 and 233.3, rounded down, plus one
    points = np.array([[-35.0, -10, 0], [-34.51, -9.0, 0], [35.0, 10.0, 0]])
    assert project_bev(points, settings, 0.5).tolist() == [[0, 0], [2, 0], [40, 140]]
    on_and_off = np.array([[35, 10, 2], [-35, -10, -1], [35.001, 0, 0], [0, 0, 2.001], [np.nan, 0, 0]])
    assert in_range(on_and_off, settings).tolist() == [True, True, False, False, False]


@pytest.mark.parametrize("connectivity", [4, 8])
def test_labelling_is_that_of_scipy(connectivity):
    for image in random_images():
        labels, count = connected_components(image, connectivity)
        expected, expected_count = ndimage.label(image, STRUCTURE[connectivity])
        assert count == expected_count and same_partition(labels.ravel(), expected.ravel())
        firsts = [np.flatnonzero(labels.ravel() == i)[0] for i in range(1, count + 1)]
        assert firsts == sorted(firsts)


def test_morphology_is_that_of_scipy():
    for image in random_images():
        filled = dilate(image)
        assert np.array_equal(filled, ndimage.binary_dilation(image, SQUARE))
        assert np.array_equal(erode(image), ndimage.binary_erosion(image, SQUARE, border_value=1))
        assert np.array_equal(erode(filled), ndimage.binary_erosion(filled, SQUARE, border_value=1))


@pytest.mark.parametrize("connectivity", [4, 8])
def test_clusters_link_pixels_up_to_distance_3(connectivity):
    # Without oversized components: Chebyshev distance <= 3, less the offsets |dx| = |dy| = 3 under 4-connectivity.
    for image in random_images():
        pixels = np.argwhere(image)
        gap = np.abs(pixels[:, None] - pixels[None])
        near = (gap.max(-1) <= 3) & ((connectivity == 8) | (gap.min(-1) < 3))
        count, expected = graph_components(csr_matrix(near), directed=False)
        found = cluster([image, image], 0.1, 1000.0, connectivity)
        assert found.max() + 1 == count and same_partition(found[image], expected)


@pytest.mark.parametrize("connectivity", [4, 8])
def test_oversized_clusters_link_pixels_of_the_closing(connectivity):
    for image in random_images():
        closed = ndimage.binary_erosion(ndimage.binary_dilation(image, SQUARE), SQUARE, border_value=1)
        expected, _ = ndimage.label(closed, STRUCTURE[connectivity])
        found = cluster([image, image], 1.0, 0.5, connectivity)
        assert same_partition(found[image], expected[image]) and (found[image] >= 0).all()


def test_counts_and_ncc_are_those_of_opencv():
    rng = np.random.default_rng(3)
    for height, width in [(1, 1), (1, 6), (5, 1), (4, 4), (7, 9), (31, 18), (60, 41)]:
        template, target = rng.random((height, width)) < 0.3, rng.random((height, width)) < 0.2
        template[rng.integers(height), rng.integers(width)] = True
        above, left = height // 2, width // 2
        padded = np.pad(target, ((above, height - 1 - above), (left, width - 1 - left))).astype(np.float32)
        overlap, energy = overlap_and_energy(template, target)
        kernel, ones = template.astype(np.float32), np.ones((height, width), dtype=np.float32)
        assert np.array_equal(overlap, np.rint(cv2.matchTemplate(padded, kernel, cv2.TM_CCORR)))
        assert np.array_equal(energy, np.rint(cv2.matchTemplate(padded, ones, cv2.TM_CCORR)))
        scores, expected = ncc_map(template, target), cv2.matchTemplate(padded, kernel, cv2.TM_CCORR_NORMED)
        np.testing.assert_allclose(scores[energy > 0], expected[energy > 0], atol=2e-6)
        assert (scores[energy == 0] == 0).all() and scores.max() <= 1


def test_ncc_map_by_hand():
    template, target = image_of([(0, 0), (1, 1)], (2, 2)), image_of([(0, 0), (0, 1), (1, 1)], (2, 2))
    # Corners (-1, -1), (-1, 0), (0, -1), (0, 0) see 1, 2, 1, 3 target pixels and match 1, 1, 0, 2.
    expected = [[1 / math.sqrt(2 * 1), 1 / math.sqrt(2 * 2)], [0.0, 2 / math.sqrt(2 * 3)]]
    np.testing.assert_allclose(ncc_map(template, target), expected, rtol=1e-15)


def test_the_peak_is_that_of_the_ncc_map():
    rng = np.random.default_rng(5)
    for _ in range(40):
        height, width = rng.integers(1, 12, 2)
        template, target = rng.random((2, height, width)) < 0.3
        template[rng.integers(height), rng.integers(width)] = True
        scores = ncc_map(template, target)
        (dx, dy), score = scene_flow_in_1view(template, target, 1.0)
        assert score == pytest.approx(scores.max(), abs=1e-15)
        rows, columns = np.nonzero(scores > scores.max() - 1e-12)
        assert (dy, dx) == min((y * y + x * x, y, x) for y, x in zip(rows - height // 2, columns - width // 2))[1:]


def test_quotients_of_counts_rank_as_fractions():
    counts = [(c, e) for e in range(2561, 2602, 4) for c in range(2301, e + 1, 7)]
    exact = sorted(counts, key=lambda n: Fraction(n[0] * n[0], n[1]))
    for (c, e), (c1, e1) in zip(exact, exact[1:]):
        assert (c * c / e < c1 * c1 / e1) == (c * c * e1 < c1 * c1 * e)
