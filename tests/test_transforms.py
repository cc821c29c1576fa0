"""Quaternions are scalar first; compared with scipy."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from cflow_torch.transforms import to_quaternions, to_rotations


def test_quaternions_of_half_turns_are_exact() -> None:
    """Naive formulas divide by zero at half turns about an axis."""
    q = np.concatenate([np.eye(4), np.random.default_rng(0).normal(size=(200, 4))])
    matrices = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    found = to_quaternions(matrices)
    assert (found[:, 0] >= 0).all() and np.abs(np.linalg.norm(found, axis=1) - 1).max() < 1e-15
    for quaternions in (found, 3 * q):
        assert np.abs(to_rotations(quaternions) - matrices).max() < 1e-14
