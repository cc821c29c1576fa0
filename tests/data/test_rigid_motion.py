"""Quaternions are scalar first; compared with scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cflow_torch.data.rigid_motion import poses_from_quaternions, to_quaternions, to_rotations


@pytest.mark.parametrize("count", [0, 1, 3, 4, 50])  # old kornia mixes up axes if there are three
def test_rotations_equal_those_of_scipy(count: int) -> None:
    rng = np.random.default_rng(count)
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    shift = rng.normal(size=(count, 3)) * 1e6
    poses = poses_from_quaternions(shift.tolist(), quaternion.tolist(), str)
    assert poses.shape == (count, 4, 4) and poses.dtype == np.float64
    if count:
        expected = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
        assert np.abs(poses[:, :3, :3] - expected).max() < 1e-14 and np.array_equal(poses[:, :3, 3], shift)


def test_quaternions_of_half_turns_are_exact() -> None:
    """Naive formulas divide by zero at half turns about an axis."""
    q = np.concatenate([np.eye(4), np.random.default_rng(0).normal(size=(200, 4))])
    matrices = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    found = to_quaternions(matrices)
    assert (found[:, 0] >= 0).all() and np.abs(np.linalg.norm(found, axis=1) - 1).max() < 1e-15
    for quaternions in (found, 3 * q):
        assert np.abs(to_rotations(quaternions) - matrices).max() < 1e-14
