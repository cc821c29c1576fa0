"""Sweeps after t+1: both sides, what they change, what they leave alone, times of points, what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Sequence

import numpy as np
import pytest
import torch
from moving_scenes import from_images
from preset_windows import untimed
from scenes import assert_same_bits, config, pose, reordered, rows_of, scene
from turning_car import MODEL, upright_box

from cflow_torch import CFlowError, FlowResult, Sweep, VerifiedFlow, Window, estimate_flow, make_config, make_model
from cflow_torch.ops.groups import Groups
from cflow_torch.verified.offline import best_nearby
from cflow_torch.verified.selection import number_objects

OFFLINE = MODEL.replace(num_history=4, num_future=4)
SPEED = 0.9  # metres per sweep, along -x


TIMES = (-4, -3, -2, -1, 0, 1, 2, 3, 4, 5)  # of sweeps; t = 0, t+1 = 1


def drive(is_hidden: bool, times: Sequence[float] = TIMES, seen: Sequence[int] = range(10)) -> list[Sweep]:
    """A car and a post.

    Args:
        is_hidden: whether the car comes out from behind something: a corner of its front is first seen at t.
        times: of the ten sweeps.
        seen: sweeps that show the car at all.
    """
    rng, sweeps = np.random.default_rng(3), []
    for k, time in enumerate(times):
        car = upright_box((3.0 - SPEED * time, 0.0), (4.4, 1.8), 0.0, rng, 2000)
        shows = (car[:, 0] + 0.7 * car[:, 1] < 0.35) if is_hidden else np.ones(len(car), dtype=bool)
        post = upright_box((-2.0, 5.0), (0.4, 0.4), 0.0, rng, 60)
        cloud = np.concatenate((car[shows & (k in seen)], post))
        sweeps.append(Sweep(cloud.astype(np.float32), timestamp_ns=10**12 + round(1e8 * time)))
    return sweeps


def error_of_car(window: Window, result: FlowResult, speed: float = SPEED) -> float:
    is_car = np.abs(window.pc0.points[:, 1]) < 2
    assert is_car.sum() > 50
    return float((result.residual_flow[is_car] - torch.tensor([-speed, 0.0, 0.0])).norm(dim=1).mean())


def window_at_t(sweeps: Sequence[Sweep], num_history: int, num_future: int) -> Window:
    """t is the fifth sweep."""
    return Window(sweeps[4], sweeps[5], tuple(sweeps[4 - num_history : 4][::-1]), tuple(sweeps[6 : 6 + num_future]))


@pytest.mark.parametrize("seed", [3, 12, 15])  # both sides are chosen
def test_every_point_takes_its_motion_from_the_past_or_from_the_future(seed):
    settings = config("verified", num_history=2, num_future=2, pixel_sizes=(0.5, 0.25), min_height=0.3)
    window = scene(700 + seed, num_history=1, num_future=2, stamps=seed % 2 > 0)
    empty = Window(*[Sweep(np.zeros((0, 3)))] * 2)
    windows = [window, empty, replace(window, pcf=()), replace(window, pch=())]
    result, _, past, future = make_model(settings)(windows)
    is_past, is_future = ((result.residual_flow == side.residual_flow).all(1) for side in (past, future))
    assert (is_past | is_future).all() and not is_past.all() and not is_future.all()
    for number in result.cluster_id[result.cluster_id >= 0].unique():
        of_object = result.cluster_id == number
        assert is_past[of_object].all() or is_future[of_object].all()  # an id has one side


def corrected(places: Sequence[Sequence[int]], given: Sequence[float], z: float = 0.0) -> list[list[float]]:
    """Motions that two windows have for a pixel at (8, 8), from a given motion: t+1 has pixels at the places; the
    second window has a sweep before t, the first one after t+1."""
    images = np.zeros((2, 3, 20, 20), dtype=np.uint8)
    images[:, 1, 8, 8] = 1
    for row, col in places:
        images[:, 0, row, col] = 1
    sweeps = from_images(images, 0.25, np.array([[0.0, 1, -1], [0, 1, 2]]))
    objects = number_objects(sweeps, Groups(sweeps.pixels.window, 2))
    motion = torch.tensor([given] * 2, dtype=torch.float64)
    return best_nearby(sweeps, objects, motion, z).tolist()


def test_a_motion_is_corrected_by_up_to_two_pixels_if_sweeps_follow():
    assert corrected([(10, 12)], (4, 2)) == [[2, 4], [4, 2]]
    assert corrected([(8, 12)], (0, 2)) == [[0, 4], [0, 2]]
    assert corrected([(10, 12)], (4.3, 3.9)) == [[2.3, 3.9], [4.3, 3.9]]
    assert corrected([(10, 12)], (5, 2)) == [[5, 2]] * 2  # three pixels
    assert corrected([(10, 12)], (0, 0)) == [[0, 0]] * 2  # static
    assert corrected([(10, 12)], (4, 2), 9.0) == [[4, 2]] * 2  # not significant
    assert corrected([(10, 15), (8, 12)], (2, 6))[0] == [2, 7]  # ties: the nearest,
    assert corrected([(11, 14), (10, 15), (9, 14), (10, 13)], (2, 6))[0] == [1, 6]  # then the first


def test_a_car_that_has_just_appeared_has_its_motion():
    sweeps, model = drive(is_hidden=True), VerifiedFlow(OFFLINE)
    for num_history in (4, 0):  # behind something; in the first window of a log
        online, offline = (window_at_t(sweeps, num_history, num_future) for num_future in (0, 4))
        assert error_of_car(online, model([online])[0]) > 0.8
        assert error_of_car(offline, model([offline])[0]) < 0.03


@pytest.mark.parametrize(
    "num_past, num_future, changes", [(0, 1, True), (1, 2, False), (1, 3, True), (2, 4, False), (4, 4, False)]
)
def test_the_future_decides_where_it_shows_an_object_more_than_twice_as_often(num_past, num_future, changes):
    sweeps, model = drive(is_hidden=False, seen=range(4 - num_past, 10)), VerifiedFlow(OFFLINE)
    window = window_at_t(sweeps, 4, num_future)
    (result,), (without,) = model([window]), model([replace(window, pcf=())])
    is_car = np.abs(window.pc0.points[:, 1]) < 2
    assert torch.equal(result.residual_flow[is_car], without.residual_flow[is_car]) != changes
    if not changes:
        assert_same_bits(result, without)
    assert_same_bits(without, VerifiedFlow(OFFLINE.replace(num_future=0))([replace(window, pcf=())])[0])


def test_objects_that_vanish_take_the_motion_from_the_past():
    sweeps = drive(is_hidden=False, seen=range(6))  # until t+1
    window = window_at_t(sweeps, 4, 4)
    (result,) = VerifiedFlow(OFFLINE)([window])
    assert_same_bits(result, VerifiedFlow(OFFLINE)([replace(window, pcf=())])[0])


def test_repeated_sweeps_after_t1_are_left_out():
    # Harnesses repeat the last sweep of a scene where there is no next one.
    window, model = scene(5, num_history=1, num_future=1), VerifiedFlow(config("verified", num_history=1, num_future=4))
    (later,) = window.pcf
    (expected,) = model([window])
    assert_same_bits(model([replace(window, pcf=(later, later, later))])[0], expected)
    (without,) = model([replace(window, pcf=())])
    assert_same_bits(model([replace(window, pcf=(window.pc1, window.pc1))])[0], without)


SMALL = make_config("offline", point_cloud_range=(-5.0, -3.0, -3.0, 4.0, 6.0, 3.0))
ROLLING = 0.8  # metres per sweep, along -x
LATER = 0.12  # sweep intervals by which the car is met later in each sweep than in the one before


def rolling_drive(num_history: int = 1, num_future: int = 4) -> Window:
    """A car and a post, met by two units half a turn apart; the car comes out from behind something: a corner of its
    front is first seen at t. Seen as it stands, it seems to go LATER farther in each interval than it goes."""
    rng, sweeps = np.random.default_rng(3), []
    for k in range(-num_history, 2 + num_future):
        clouds, times = [upright_box((-2.0, 5.0), (0.4, 0.4), 0.0, rng, 60)], [rng.uniform(0, 1, 60)]
        for unit in (0.0, 0.5):
            time = LATER * k + unit - 0.4
            car = upright_box((3.0 - ROLLING * (k + time), 0.0), (4.4, 1.8), 0.0, rng, 1000)
            clouds.append(car[car[:, 0] + 0.7 * car[:, 1] < 0.35])
            times.append(np.full(len(clouds[-1]), time))
        sweeps.append(Sweep(np.concatenate(clouds).astype(np.float32), point_times=0.1 * np.concatenate(times)))
    t = num_history
    return Window(sweeps[t], sweeps[t + 1], tuple(sweeps[:t][::-1]), tuple(sweeps[t + 2 :]))


@pytest.mark.parametrize("num_history", [0, 1])
def test_times_correct_the_motion_of_an_object_that_has_just_appeared(num_history):
    window, model = rolling_drive(num_history), VerifiedFlow(SMALL)
    windows = window, untimed(window), replace(window, pcf=())
    error, without_times, without_future = (error_of_car(w, model([w])[0], ROLLING) for w in windows)
    assert error < 0.03
    assert without_times == pytest.approx(LATER * ROLLING, abs=0.03) and without_future > 0.5


def test_alone_or_in_a_batch_in_any_order_of_points():
    model = VerifiedFlow(SMALL)
    windows: list[Window] = [rolling_drive(), untimed(rolling_drive(0)), rolling_drive(1, 0), rolling_drive(0, 2)]
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
        mixed, order = reordered(window)
        assert_same_bits(model([mixed])[0], rows_of(result, order))


def test_ground_of_the_future_is_found_too():
    sweeps = drive(is_hidden=False)
    rng = np.random.default_rng(0)
    floor = np.concatenate((rng.uniform(-7, 7, (4000, 2)), np.full((4000, 1), -1.75)), 1)
    clouds = [np.concatenate((sweep.points, floor.astype(np.float32))) for sweep in sweeps]
    now, newest, *future = map(Sweep, clouds[4:])
    result = estimate_flow(now, newest, future=future, ground="auto", preset="offline")
    assert not result.is_valid[-4000:].any() and result.is_valid[: len(sweeps[4].points)].float().mean() > 0.9
    assert error_of_car(Window(sweeps[4], sweeps[5]), replace(result, residual_flow=result.residual_flow[:-4000])) < 0.1


P = np.random.default_rng(0).uniform(-5, 5, (50, 3)).astype(np.float32)


def later(offset: float, stamp: int | None, pose: np.ndarray | None = None) -> Sweep:
    return Sweep(P + np.float32(offset), pose=pose, timestamp_ns=stamp)


@pytest.mark.parametrize(
    "pcf, T_world_ego, complaint",
    [
        ((later(1, 200), later(2, 150)), None, "out of order.*pcf1"),
        ((later(1, 100),), None, "out of order"),  # the time of t+1
        ((later(1, 200, np.eye(4)),), None, "pose of every sweep"),
        (P, None, "pcf is ndarray"),
        (tuple(later(i, 200 + i) for i in range(5)), None, "5 future sweeps but num_future=4"),
        ((later(1, 200, pose(500.0, 0.0, 0.0)),), np.eye(4), "moves 500 m between pcf1 and pc1"),
        ((later(1, 200, -np.eye(4)),), np.eye(4), "pose of pcf1 is not rigid"),
    ],
)
def test_bad_sweeps_after_t1_are_refused(pcf, T_world_ego, complaint):
    with pytest.raises(CFlowError, match=complaint):
        VerifiedFlow(OFFLINE)([Window(later(-1, 0, T_world_ego), later(0, 100, T_world_ego), (), pcf)])
