from __future__ import annotations

import numpy as np
import pytest

from cflow_torch.transforms import interpolate_poses, transform_each
from cflow_torch.types import CFlowError
from cflow_torch.windows.deskewing import deskew_points, scan_fractions


def driving(yaw: float, x: float, y: float, pitch: float = 0.02) -> np.ndarray:
    """A step of a vehicle: T_ego0_ego1."""
    cos, sin, lift = np.cos(yaw), np.sin(yaw), np.sin(pitch)
    level = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    nod = np.array([[np.cos(pitch), 0, lift], [0, 1, 0], [-lift, 0, np.cos(pitch)]])
    step = np.eye(4)
    step[:3, :3] = level @ nod
    step[:3, 3] = x, y, 0.1
    return step


def test_points_of_a_fixed_world_return_to_where_they_are_at_the_instant_of_the_sweep():
    """Interpolated poses of three sweeps are the reference: by quaternions, and in the frame of the world."""
    random = np.random.default_rng(1)
    pose = driving(1.2, 400, -300)
    poses = np.stack([pose @ np.linalg.inv(driving(0.05, 2, 0.2)), pose, pose @ driving(-0.08, 1.5, -0.1)])
    world = random.uniform(-40, 40, (500, 3)) + pose[:3, 3]
    fraction = random.uniform(-0.5, 0.5, 500)
    first = np.where(fraction > 0, 1, 0)
    at = interpolate_poses(poses[first], poses[first + 1], np.where(fraction > 0, fraction, 1 + fraction))
    measured = transform_each(world, np.linalg.inv(at))
    T_ego1_ego0, T_ego0_before = (np.linalg.inv(poses[k + 1]) @ poses[k] for k in (1, 0))
    expected = transform_each(world, np.linalg.inv(poses[[1]]).repeat(500, 0))
    assert np.abs(measured - expected).max() > 0.5
    found = deskew_points(measured, fraction, T_ego1_ego0, T_ego0_before)
    assert np.abs(found - expected).max() < 1e-10
    single = deskew_points(measured.astype(np.float32), fraction, T_ego1_ego0, T_ego0_before)
    assert single.dtype == np.float32 and np.abs(single - expected).max() < 1e-5


def test_without_an_earlier_sweep_the_motion_is_constant():
    points, fraction = np.array([[10.0, 5, 1], [10, 5, 1]]), np.array([-0.25, 0.0])
    motion = np.linalg.inv(driving(0.1, 2, 0))
    assert np.array_equal(deskew_points(points, fraction, motion), deskew_points(points, fraction, motion, motion))
    assert np.array_equal(deskew_points(points, fraction, motion)[1], points[1])
    straight = np.eye(4)
    straight[0, 3] = -2  # the vehicle drives 2 m ahead
    assert np.allclose(deskew_points(points, fraction, straight), points + [[-0.5, 0, 0], [0, 0, 0]], atol=1e-12)


def test_a_clockwise_lidar_looks_left_first_then_ahead_then_right():
    points = np.array([[1.0, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 1e-9, 0], [-1, -1e-9, 0]])
    assert np.allclose(scan_fractions(points, "clockwise"), [0, -0.25, 0.25, -0.5, 0.5])
    assert np.allclose(scan_fractions(points, "counterclockwise"), [0, 0.25, -0.25, 0.5, -0.5])
    assert np.allclose(scan_fractions(points + (3, 4, 5), "clockwise", (3, 4, 5)), [0, -0.25, 0.25, -0.5, 0.5])


def test_a_turn_may_begin_elsewhere():
    azimuth = np.radians([0, 80, 100, 170, -170, -100, -80, -10])
    points = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    degrees = {
        "clockwise_left": [0, -80, 260, 190, 170, 100, 80, 10],
        "clockwise_ahead": [0, 280, 260, 190, 170, 100, 80, 10],
        "clockwise_right": [0, -80, -100, -170, -190, -260, 80, 10],
        "counterclockwise_left": [0, 80, -260, -190, -170, -100, -80, -10],
        "counterclockwise_right": [0, 80, 100, 170, 190, 260, -80, -10],
        "clockwise_at_start": [180, 100, 80, 10, 350, 280, 260, 190],
        "clockwise_at_end": [-180, -260, -280, -350, -10, -80, -100, -170],
        "clockwise_left_at_start": [90, 10, 350, 280, 260, 190, 170, 100],
        "counterclockwise_right_at_end": [-270, -190, -170, -100, -80, -10, -350, -280],
    }
    for name, expected in degrees.items():
        assert np.allclose(360 * scan_fractions(points, name), expected), name


@pytest.mark.parametrize(
    "change, complaint",
    [
        ({"fraction": np.zeros(2)}, r"fraction has shape \(2,\).*sweep intervals"),
        ({"points": np.zeros((3, 2))}, "points has shape"),
        ({"T_ego1_ego0": 2 * np.eye(4)}, "T_ego1_ego0 is not rigid"),
    ],
)
def test_wrong_arguments_are_refused(change, complaint):
    given = {"points": np.zeros((3, 3)), "fraction": np.zeros(3), "T_ego1_ego0": np.eye(4), **change}
    with pytest.raises(CFlowError, match=complaint):
        deskew_points(**given)
    with pytest.raises(CFlowError, match="direction='left'.*clockwise"):
        scan_fractions(np.zeros((3, 3)), "left")
