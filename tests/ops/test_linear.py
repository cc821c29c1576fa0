"""Adjugates and determinants of symmetric matrices: NumPy's, exact for whole numbers, and one matrix at a time."""

from __future__ import annotations

import numpy as np
import torch

from cflow_torch.ops.linear import adjugate


def test_adjugate_is_the_inverse_times_the_determinant():
    factors = np.random.default_rng(0).normal(size=(50, 3, 3))
    matrices = factors @ factors.transpose(0, 2, 1)
    found, determinant = adjugate(torch.from_numpy(matrices.transpose(1, 2, 0).copy()))
    inverse = (found / determinant).permute(2, 0, 1)
    np.testing.assert_allclose(inverse, np.linalg.inv(matrices), rtol=1e-8)
    np.testing.assert_allclose(determinant, np.linalg.det(matrices), rtol=1e-8)
    alone = [adjugate(torch.from_numpy(matrix[:, :, None].copy()))[0] for matrix in matrices]
    assert torch.equal(torch.cat(alone, 2), found)


def test_singular_whole_numbers_give_exactly_zero():
    matrix = torch.tensor([[1.0, 2, 3], [2, 4, 6], [3, 6, 9]], dtype=torch.float64)[:, :, None]
    found, determinant = adjugate(matrix)
    assert not found.any() and determinant.tolist() == [0.0]
