"""Closing and erosion against SciPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import ndimage

from cflow_torch.ops import morphology
from cflow_torch.ops.kornia_engine import close_3x3_kornia
from cflow_torch.ops.labeling import pad

SQUARE = np.ones((1, 3, 3), dtype=bool)


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (1, 8, 1), (3, 13, 17), (2, 11, 12), (0, 5, 5)])
def test_closing_equals_scipy(shape):
    rng = np.random.default_rng(len(shape))
    for density in (0.0, 0.1, 0.5, 0.95, 1.0):
        image = rng.random(shape) < density
        given = torch.from_numpy(image)
        padded = pad([given])
        before = padded.clone()
        found = morphology.close_3x3(padded, *shape[1:])
        closed = found[:, : shape[1], : shape[2]]
        assert found.shape == padded.shape and found.sum() == closed.sum()  # nothing in the margin
        assert torch.equal(padded, before)
        if image.size:
            dilated = ndimage.binary_dilation(image, SQUARE)
            assert (closed.numpy() == ndimage.binary_erosion(dilated, SQUARE, border_value=1)).all()
            assert torch.equal(close_3x3_kornia(given), closed)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 2), (9, 13)])
def test_erosion_with_a_cross_is_scipys_with_background_outside(shape):
    for seed in range(8):
        image = np.random.default_rng(seed).random((2, *shape)) < 0.8
        expected = np.stack([ndimage.binary_erosion(part, border_value=0) for part in image])
        assert np.array_equal(morphology.erode_cross(torch.from_numpy(image)).numpy(), expected)
