"""Where sweeps measured: plain loops, a sensor that sees a part of its surroundings only, and lost packets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import assert_same_bits, sweeps_of

from cflow_torch import VerifiedFlow
from cflow_torch.config import VerifiedConfig
from cflow_torch.evaluation.frame import ego_motion_flow
from cflow_torch.ops.groups import Groups
from cflow_torch.simulator import Drive, make_drive
from cflow_torch.types import Sweep, Window
from cflow_torch.verified.comparisons import count_in_place
from cflow_torch.verified.paired_test import count_wins
from cflow_torch.windows.coverage import Coverage

NUM_BINS = 182  # two of them are the y axis
SHORTEST = 16


def bin_of(x: float, y: float) -> int:
    """Of the vector; half of the circle has length 2, and y / (|x| + |y|) measures a quarter of the circle."""
    number = int((y / (abs(x) + abs(y)) + 1) * 45)
    return number if x >= 0 else NUM_BINS - 1 - number


def unmeasured_by_loops(points: np.ndarray) -> list[bool]:
    """Of the points of a sweep, (N, 2), which have ground among them."""
    is_empty = [True] * NUM_BINS
    for x, y in points.tolist():
        is_empty[bin_of(x, y)] = False
    result = [False] * NUM_BINS
    for start in range(NUM_BINS):
        run = [(start + i) % NUM_BINS for i in range(SHORTEST)]
        if all(is_empty[i] for i in run):
            for i in run:
                result[i] = True
    return result


def test_equals_plain_loops_for_sweeps_alone_and_together():
    rng = np.random.default_rng(0)
    sweeps = []
    for low, high in ((-0.6, 0.6), (-3.1, 2.9), (2.8, 3.5), (-2.0, 2.3)):
        angle = rng.uniform(low, high, 300)
        sweeps.append(rng.uniform(2, 50, (300, 1)) * np.stack((np.cos(angle), np.sin(angle)), 1))
    clouds = [torch.from_numpy(points).float().double().t() for points in sweeps]
    is_ground = torch.arange(300) < 5
    angle = np.array([0.0, 0.7, -2.0, 3.0])  # from ego1 to the frame of each sweep
    T_ego1_ego = torch.zeros((3, 4, 4), dtype=torch.float64)
    T_ego1_ego[0, 0], T_ego1_ego[1, 0] = torch.from_numpy(np.stack((np.cos(angle), np.sin(angle))))
    alone, together = (Coverage(2, 2, torch.device("cpu")) for _ in range(2))
    for image, cloud in enumerate(clouds):
        # The last sweep has no ground.
        alone.add(image, cloud, T_ego1_ego[..., image, None], is_ground & (image != 3))
    image = torch.arange(4, dtype=torch.int32).repeat_interleave(300)
    ground = is_ground.repeat(4) & (image != 3)
    together.add(image, torch.cat(clouds, 1), T_ego1_ego.repeat_interleave(300, 2), ground)

    directions = rng.normal(size=(500, 2))
    window = torch.arange(500) % 2
    offset = torch.from_numpy(directions.T.copy())[..., None].expand(2, 500, 2)
    found = alone.is_unmeasured(window, offset)
    assert torch.equal(together.is_unmeasured(window, offset), found) and alone.has_gaps()
    flags = [unmeasured_by_loops(cloud.t().numpy()) for cloud in clouds[:3]] + [[False] * NUM_BINS]
    for (x, y), of_window, row in zip(directions.tolist(), window.tolist(), found.tolist()):
        for step, is_unmeasured in enumerate(row):
            cos, sin = np.cos(angle[2 * of_window + step]), np.sin(angle[2 * of_window + step])
            assert is_unmeasured == flags[2 * of_window + step][bin_of(cos * x + sin * y, cos * y - sin * x)]
    assert sum(flags[0]) > 100 and sum(flags[1]) == 0 and sum(flags[2]) > 100


REGION = (-9.0, -9.0, -3.0, 9.0, 9.0, 3.0)
DEGREES = np.arange(0, 360, 0.5)
ANGLE = np.radians(DEGREES)
RING = np.stack((5 * np.cos(ANGLE), 5 * np.sin(ANGLE), np.full_like(ANGLE, -1.6)), 1).astype(np.float32)  # the ground
IS_LEFT = (DEGREES > 10) & (DEGREES < 80)


def block(low: tuple[float, float, float], seed: int = 0) -> np.ndarray:
    """Points of a block with a side of a metre."""
    return np.random.default_rng(seed).uniform(low, np.add(low, 1), (60, 3)).astype(np.float32)


def on_ring(*blocks: np.ndarray) -> Sweep:
    """A sweep of blocks on the ground."""
    points = np.concatenate((RING, *blocks))
    return Sweep(points, is_ground=np.arange(len(points)) < len(RING))


def test_copies_are_filled_where_a_sweep_did_not_measure():
    """Windows of a block ahead to the left at t: in the second one, t+1 did not measure there."""
    at_t = on_ring(block((2, 2, 0)))
    whole, partial = (Sweep(points, is_ground=np.ones(len(points), bool)) for points in (RING, RING[~IS_LEFT]))
    settings = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION)
    sweeps = sweeps_of([Window(at_t, whole), Window(at_t, partial)], settings)
    rows = sweeps.points.is_member.nonzero()[:, 0]
    copied = sweeps.with_copies(rows)
    copies = copied.pixels[torch.arange(sweeps.num_pixels, copied.num_pixels)]
    assert len(rows) == 2 * 60 and len(copies) == sweeps.num_pixels
    assert torch.equal(copied.columns.are_filled(copies, 0), copies.window == 3)
    assert torch.equal(copied.columns.look_up(copies, 0), sweeps.columns.look_up(sweeps.pixels, 0))


def test_what_was_not_measured_is_evidence_neither_for_a_motion_nor_against_it():
    """Two blocks at t. Sweep t+1 did not measure the place of the second: there, nothing arrives, and nothing stays."""
    two = on_ring(block((2, -1.5, 0)), block((2, 2, 0)))
    partial = Sweep(RING[~IS_LEFT], is_ground=np.ones((~IS_LEFT).sum(), bool))
    settings = VerifiedConfig(pixel_sizes=(0.25,), point_cloud_range=REGION)
    sweeps = sweeps_of([Window(two, partial)], settings)
    blocks = Groups((sweeps.pixels.row_col[0] > 36 + 4).long(), 2)  # the middle is row 36
    motions = torch.tensor([[[14.0, 0.0]], [[-14.0, 0.0]]], dtype=torch.float64)  # 3.5 m
    exact, near = count_wins(sweeps, sweeps.pixels, blocks, motions)
    assert not torch.stack((*exact, *near)).any()
    in_place = count_in_place(sweeps, sweeps.pixels, blocks)
    assert in_place.compared[0] > 20 and in_place.compared[1] == 0 and in_place.found.tolist() == [0, 0]


@pytest.mark.parametrize("step", [1.5, 2.5])
def test_a_car_moves_whose_place_older_sweeps_did_not_measure(step):
    """A car on an empty road. Sweeps before t lack a third of the circle, in which the car is."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-40, 40, (2, 20000))
    ground = np.stack((x, y, rng.normal(-1.7, 0.01, 20000)), 1)
    sweeps = []
    for age in range(6):
        car = (-2 - age * step, 12.0, -1.4) + rng.uniform(0, 1, (400, 3)) * (4.2, 1.8, 1.4)
        points = np.concatenate((ground, car)).astype(np.float32)
        azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
        kept = (azimuth < 30) | (azimuth > 150) | (age < 2)
        is_ground = np.arange(len(points)) < len(ground)
        sweeps.append(Sweep(points[kept], is_ground=is_ground[kept], pose=np.eye(4)))
    newest, now, *history = sweeps
    (result,) = VerifiedFlow.from_preset("default")([Window(now, newest, pch=tuple(history))])
    error = (result.residual_flow[-400:] - torch.tensor([step, 0, 0])).norm(dim=1)
    assert error.max() < 0.15 and not result.residual_flow[:-400].any()


def cut(sweep: Sweep, is_front: bool, is_lost: bool) -> np.ndarray:
    """The points, (N,) bool, of a view of 70 degrees to the front, or what is left if a quarter is lost."""
    azimuth = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
    return np.abs(azimuth) < 35 if is_front else ~(is_lost & (azimuth > 0) & (azimuth < 90))


def cut_window(drive: Drive, is_front: bool, pair: int, num_history: int = 4) -> Window:
    """A pair of a drive with older sweeps, each of which is cut."""
    sweeps = []
    for index in range(pair + 1, pair - 1 - num_history, -1):
        sweep = drive.sweep(index)
        kept = cut(sweep, is_front, index % 3 == 0)
        sweeps.append(Sweep(sweep.points[kept], is_ground=sweep.is_ground[kept], pose=sweep.pose))
    newest, now, *history = sweeps
    return Window(now, newest, pch=tuple(history))


@pytest.mark.parametrize(("is_front", "pair"), [(True, 7), (False, 11)])
def test_static_points_stay_static_where_sweeps_are_cut(is_front, pair):
    drive = make_drive(seed=1, num_sweeps=pair + 2, profile="demo", scene="street")
    window = cut_window(drive, is_front, pair)
    (result,) = VerifiedFlow.from_preset("default", min_height=None)([window])  # low points may be unknown, too
    sweep = drive.sweep(pair)
    T_ego1_ego0 = np.linalg.inv(window.pc1.pose) @ window.pc0.pose
    truth = drive.labels(pair).flow - ego_motion_flow(sweep.points, T_ego1_ego0)
    speed = np.linalg.norm(truth, axis=1)[cut(sweep, is_front, pair % 3 == 0)]
    moves = result.is_moving.numpy()
    assert (moves & (speed < 0.001)).sum() < 60
    assert moves[speed > 0.3].mean() > 0.7  # of the others, t+1 has lost the points
    # Whether points move that t+1 did not measure, nobody knows. A few cells at the borders of the azimuths differ.
    at_newest = window.pc0.points.astype(np.float64) @ T_ego1_ego0[:2, :3].T + T_ego1_ego0[:2, 3]
    azimuth = np.degrees(np.arctan2(at_newest[:, 1], at_newest[:, 0]))
    is_unknown = np.abs(azimuth) > 37 if is_front else (azimuth > 2) & (azimuth < 88)
    is_static = (result.is_valid & (result.residual_flow == 0).all(1)).numpy()
    is_half = (result.confidence == 0.5).numpy()
    assert is_front or ((is_unknown & is_static).sum() > 100 and is_half[is_unknown & is_static].mean() > 0.95)
    assert not is_half[np.abs(azimuth) < 33 if is_front else azimuth < -2].any()


def test_cut_sweeps_in_a_batch_give_the_bits_of_each_window_alone():
    drive = make_drive(seed=1, num_sweeps=6, profile="demo", scene="street")
    whole = Window(drive.sweep(3), drive.sweep(4), pch=(drive.sweep(2),))
    windows = [cut_window(drive, True, 3, 1), whole, cut_window(drive, False, 2, 1)]
    model = VerifiedFlow.from_preset("default")
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
