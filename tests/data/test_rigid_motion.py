"""Quaternions are scalar first, motions take the shorter way at a constant rate: against known values and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from cflow_torch.data.rigid_motion import (
    between,
    moved,
    poses_at,
    poses_from_quaternions,
    to_quaternions,
    to_rotations,
)

HALF = math.sqrt(0.5)


def test_the_scalar_comes_first() -> None:
    """A quarter turn about z takes x to y; read in another order the same numbers turn about another axis."""
    pose = poses_from_quaternions([[1, 2, 3]], [[HALF, 0, 0, HALF]], str)[0]
    np.testing.assert_allclose(pose, [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], atol=1e-15)
    np.testing.assert_allclose(moved(np.array([[1.0, 0, 0]]), pose), [[1, 3, 3]], atol=1e-15)
    about_x = poses_from_quaternions([[0, 0, 0]], [[HALF, HALF, 0, 0]], str)[0]
    np.testing.assert_allclose(moved(np.array([[0.0, 1, 0]]), about_x), [[0, 0, 1]], atol=1e-15)


@pytest.mark.parametrize("count", [0, 1, 3, 4, 50])  # old kornia crosses along the wrong axis where there are three
def test_rotations_are_those_of_scipy(count: int) -> None:
    rng = np.random.default_rng(count)
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    shift = rng.normal(size=(count, 3)) * 1e6
    poses = poses_from_quaternions(shift.tolist(), quaternion.tolist(), str)
    assert poses.shape == (count, 4, 4) and poses.dtype == np.float64
    if count:
        expected = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).as_matrix()
        assert np.abs(poses[:, :3, :3] - expected).max() < 1e-14 and np.array_equal(poses[:, :3, 3], shift)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-3, 0.5, 3.1])
def test_the_way_between_two_poses(turn: float) -> None:
    """Also beyond both ends, and the shorter way round where the two quaternions have opposite signs."""
    start, axis = Rotation.from_euler("xyz", [0.3, -1.0, 2.9]), np.array([0.6, 0.0, 0.8])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, :3], poses[1, :3, :3] = start.as_matrix(), (start * Rotation.from_rotvec(turn * axis)).as_matrix()
    poses[1, :3, 3] = [4, 0, 0]
    fraction = np.array([-0.5, 0, 0.25, 1, 1.5])
    found = between(*(np.repeat(poses[k : k + 1], 5, axis=0) for k in (0, 1)), fraction)
    expected = (start * Rotation.from_rotvec(turn * fraction[:, None] * axis)).as_matrix()
    assert np.abs(found[:, :3, :3] - expected).max() < 1e-14
    np.testing.assert_allclose(found[:, :3, 3], 4 * fraction[:, None] * [1, 0, 0])
    at = poses_at(np.array([150, 200]), np.array([100, 200]), poses)
    slerp = Slerp([100, 200], Rotation.from_matrix(poses[:, :3, :3]))
    assert np.abs(at[:, :3, :3] - slerp([150, 200]).as_matrix()).max() < 1e-14


def test_quaternions_of_any_rotation_and_of_half_turns() -> None:
    """Half turns about each axis are where naive formulas divide by zero."""
    q = np.concatenate([np.eye(4), np.random.default_rng(0).normal(size=(200, 4))])
    matrices = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()
    found = to_quaternions(matrices)
    assert (found[:, 0] >= 0).all() and np.abs(np.linalg.norm(found, axis=1) - 1).max() < 1e-15
    for quaternions in (found, 3 * q):
        assert np.abs(to_rotations(quaternions) - matrices).max() < 1e-14
