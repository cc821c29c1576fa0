"""Key points and their descriptors: distance transform, patches, the oracle, by hand."""

from __future__ import annotations

from typing import List, Tuple

import numpy as np
import pytest
import torch
from oracle.matching import detect_keypoints
from scipy import ndimage

from cflow_torch.keypoints.descriptors import detect


def block(rows, cols) -> List[Tuple[int, int]]:
    return [(r, c) for r in rows for c in cols]


@pytest.mark.parametrize(
    "pixels, inner",
    [
        ([(4, 6)], []),
        ([(2, c) for c in range(12)], []),  # a line
        (block(range(3, 8), range(2, 7)), block(range(4, 7), range(3, 6))),  # a square: its ring
        (block(range(3), range(3)), [(1, 1)]),  # in the corner: outside the image is background
        ([(4, 5), (5, 4), (5, 5), (5, 6), (6, 5)], [(5, 5)]),  # a free diagonal neighbour does not matter
        ([], []),
    ],
)
def test_keypoints_are_the_boundary(pixels, inner):
    image = np.zeros((12, 12), dtype=bool)
    for pixel in pixels:
        image[pixel] = True
    expected = sorted(set(pixels) - set(inner))
    assert [tuple(p) for p in detect_keypoints(image).tolist()] == expected
    assert [tuple(p) for p in detect(torch.from_numpy(image)).nonzero().tolist()] == expected


def test_keypoints_are_at_distance_one():
    rng = np.random.default_rng(0)
    for density in (0.02, 0.3, 0.7, 0.95, 1.0, 0.0):
        image = rng.random((23, 31)) < density
        distance = ndimage.distance_transform_edt(np.pad(image, 1))[1:-1, 1:-1]  # outside the image is background
        assert np.array_equal(detect(torch.from_numpy(image)).numpy(), distance == 1)
