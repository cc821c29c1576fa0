"""Alignment: poses that are off by centimetres are corrected. Good poses, and what a vehicle does, change nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import assert_same_bits, pose, sweeps_of

from cflow_torch import Sweep, VerifiedFlow, Window, estimate_flow
from cflow_torch.config import VerifiedConfig
from cflow_torch.diagnosis.inspection import MotionWatch, pose_error
from cflow_torch.errors import CFlowWarning
from cflow_torch.transforms import relative_transform, transform_points
from cflow_torch.verified import alignment
from cflow_torch.verified.rigid_motion import RigidMotion
from cflow_torch.windows.collation import make_batch

MODEL = VerifiedConfig(point_cloud_range=(-24.0, -24.0, -3.0, 24.0, 24.0, 5.0), max_speed=40.0)
EXACT, NOISY = (0.0, 0.0), (0.04, 0.3)  # metres and degrees, standard deviations of the errors of the poses
CAR = slice(-2000, None)  # its points come last


def drive(noise: tuple[float, float], num_history: int = 0, num_posts: int = 60, seed: int = 0) -> Window:
    """Posts around a vehicle that turns, and a car that drives 0.6 m a sweep. Every sweep is sampled anew."""
    metres, degrees = noise
    rng, errors = np.random.default_rng(seed), np.random.default_rng(seed + 100)
    corners = rng.uniform(-20, 20, (num_posts, 2))
    corners = corners[(np.abs(corners - (8, 0)) > (8, 3)).any(1) & (np.abs(corners) > 2).any(1)]
    surface = np.stack(np.meshgrid(np.arange(0, 0.81, 0.1), np.arange(0, 0.81, 0.1), np.arange(0, 1.6, 0.1)), -1)
    surface = surface[((surface[..., :2] == 0) | (surface[..., :2] > 0.75)).any(-1)]  # the sides of a post
    posts = (np.pad(corners, ((0, 0), (0, 1)))[:, None] + surface).reshape(-1, 3)
    sweeps = []
    for k in range(1, -num_history - 1, -1):  # t+1 first
        static = posts[rng.random(len(posts)) < 0.7]
        car = np.array((6.0, -0.9, 0.0)) + rng.random((2000, 3)) * (4.0, 1.8, 1.5) + (0.6 * k, 0, 0)
        T_world_ego = pose(0.3 * k, 0.0, 0.02 * k)
        points = transform_points(np.concatenate((static, car)), np.linalg.inv(T_world_ego))
        points += rng.normal(0, 0.01, points.shape)
        error = pose(*errors.normal(0, metres, 2), np.radians(errors.normal(0, degrees)))
        is_ground = np.zeros(len(points), bool)
        sweeps.append(Sweep(points.astype(np.float32), is_ground, T_world_ego @ error, timestamp_ns=(10 + k) * 10**8))
    pc1, pc0, *history = sweeps
    return Window(pc0, pc1, tuple(history))


def true_flow(points: np.ndarray) -> np.ndarray:
    """(N, 3) total flow of the points of t of `drive`."""
    world = points[:, :3].astype(np.float64)
    world = np.concatenate((world[: CAR.start], world[CAR] + (0.6, 0, 0)))
    return transform_points(world, np.linalg.inv(pose(0.3, 0.0, 0.02))) - points[:, :3]


def without_alignment() -> VerifiedFlow:
    model = VerifiedFlow(MODEL)
    model.align = lambda sweeps, draw: sweeps
    return model


@pytest.mark.parametrize("num_history", [0, 2])
def test_noisy_poses_are_corrected(num_history):
    window = drive(NOISY, num_history)
    (result,) = VerifiedFlow(MODEL)([window])
    error = np.linalg.norm(result.flow.numpy() - true_flow(window.pc0.points), axis=1)
    assert error[: CAR.start].max() < 0.02 and error[CAR].mean() < 0.03
    assert not result.residual_flow[: CAR.start].any()
    (result,) = without_alignment()([window])
    assert (result.residual_flow[: CAR.start].norm(dim=1) > 0.03).float().mean() > 0.5


def test_exact_poses_keep_their_bits():
    window = drive(EXACT, num_history=2)
    assert_same_bits(VerifiedFlow(MODEL)([window])[0], without_alignment()([window])[0])


def test_a_result_does_not_depend_on_other_windows_of_the_batch():
    windows = [drive(EXACT), drive(NOISY, num_history=2), drive(NOISY, seed=1)]
    model = VerifiedFlow(MODEL)
    for result, window in zip(model(windows), windows):
        assert_same_bits(result, model([window])[0])


def test_a_car_alone_is_not_the_world():
    """It moves by less than the alignment reaches, and nothing else is seen."""
    car = np.random.default_rng(0).random((4000, 3)) * (4.0, 1.8, 1.5) + (5, 0, 0)
    window = Window(Sweep(car.astype(np.float32)), Sweep((car + (0.15, 0, 0)).astype(np.float32)))
    sweeps = sweeps_of([window], MODEL)
    registration, motion = alignment._register(sweeps, 3000, 6)
    gains = alignment.Gains.of(registration, motion)
    assert gains.are_large()[1] and not alignment.Votes.of(sweeps, registration, gains.of_voxel).agree().any()
    (result,) = VerifiedFlow(MODEL)([window])
    assert torch.allclose(result.residual_flow, torch.tensor([0.15, 0.0, 0.0]), atol=0.02)


def test_a_correction_acts_as_other_poses():
    """Of positions, origins and pose flow."""
    given, right = drive(NOISY, num_history=2), drive(EXACT, num_history=2)
    grid = VerifiedFlow(MODEL).grid(0.1)
    batch, expected = (
        make_batch([window], MODEL, grid, torch.device("cpu"), 3, needs_ground=True) for window in (given, right)
    )
    flow, rotation = torch.zeros(4, 2, dtype=torch.float64), torch.zeros(4, dtype=torch.float64)
    others = ((window.pc0, *window.pch) for window in (given, right))
    for step, (noisy, exact) in enumerate(zip(*others), 1):
        T_ego1_noisy = relative_transform(given.pc1.pose, noisy.pose)
        T_exact_noisy = relative_transform(right.pc1.pose, exact.pose) @ np.linalg.inv(T_ego1_noisy)
        flow[step] = torch.from_numpy(T_exact_noisy[:2, 3])
        rotation[step] = np.tan(np.arctan2(T_exact_noisy[1, 0], T_exact_noisy[0, 0]) / 2)
    moved = alignment.corrected(batch, RigidMotion(flow, rotation, torch.zeros_like(flow)), grid)
    for name in ("positions", "origin", "pose_flow"):
        assert torch.allclose(getattr(moved, name), getattr(expected, name), atol=1e-6), name
    assert not torch.allclose(batch.positions, expected.positions, atol=0.01)


def test_blocks_vote():
    """12 of 14 blocks suffice. Nine alone do not, nor does a small majority."""
    votes = alignment.Votes(torch.tensor([12, 9, 12, 0]), torch.tensor([2, 0, 4, 0]))
    assert votes.agree().tolist() == [True, False, False, False]


def test_small_gains_and_those_within_the_noise_change_nothing():
    mean = torch.tensor([0.02, 0.005, 0.02, float("nan")], dtype=torch.float64)
    z = torch.tensor([9.0, 9.0, 2.0, float("nan")], dtype=torch.float64)
    assert alignment.Gains(mean, mean, z).are_large().tolist() == [True, False, False, False]


def test_a_correction_is_told_once():
    window, watch = drive(NOISY), MotionWatch()
    (result,) = VerifiedFlow(MODEL)([window])
    assert 0.05 < pose_error(window, result) < 0.5
    assert "so the poses are off" in watch(window, result) and watch(window, result) == ""
    assert pose_error(drive(EXACT), VerifiedFlow(MODEL)([drive(EXACT)])[0]) == 0
    with pytest.warns(CFlowWarning, match="so the poses are off"):
        estimate_flow(window.pc0, window.pc1, preset=MODEL, ground=None)


def test_a_sensor_without_poses_may_move_a_little():
    """All points should be in the frame of t+1, but are 8 cm off."""
    window = drive(EXACT).with_sweeps([replace(sweep, pose=None) for sweep in drive(EXACT).sweeps])
    shifted = window.pc1.points - np.float32((0.08, 0, 0))
    T_ego1_ego0 = np.linalg.inv(pose(0.3, 0.0, 0.02))
    at_t = transform_points(window.pc0.points, T_ego1_ego0).astype(np.float32)
    window = Window(replace(window.pc0, points=at_t), replace(window.pc1, points=shifted))
    (result,) = VerifiedFlow(MODEL)([window])
    assert not result.residual_flow[: CAR.start].any()
    assert torch.allclose(result.pose_flow.median(0).values, torch.tensor([-0.08, 0.0, 0.0]), atol=0.01)
    assert "there are no poses" in MotionWatch()(window, result)


def test_both_sides_of_a_recording_have_one_motion_of_t():
    """With later sweeps, t is in a window of each side."""
    batch = make_batch([drive(NOISY)], MODEL, VerifiedFlow(MODEL).grid(0.1), torch.device("cpu"), 3)
    motion = RigidMotion(torch.arange(12.0).view(6, 2), torch.arange(6.0), torch.zeros(6, 2))
    alike = alignment._alike_at_t(motion, replace(batch, num_windows=2, num_steps=3))
    assert alike.flow[:, 0].tolist() == [0, 2, 4, 6, 2, 10] and alike.rotation.tolist() == [0, 1, 2, 3, 1, 5]
