"""The verified method as a whole: equal to the oracle, also at the border of the region; what each part is for."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from preset_windows import untimed
from scenes import config, flow_as_oracle, scene
from turning_car import MODEL, car_of, turning_car, upright_box

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.log import window as window_of
from cflow_torch.verified import candidates, motion_margin, paired_test

NEAR = (-12.0, -3.0, -math.inf, -2.0, 4.0, math.inf)
WIDER = (-35.0, -25.0, -math.inf, 25.0, 25.0, math.inf)


# Twelve seeds have every pair of a number of sweeps and a set of pixel sizes.
@pytest.mark.parametrize("seed", [*range(8), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(8, 18))])
def test_equals_the_oracle_on_random_scenes(seed, numbered, monkeypatch):
    if seed % 4 == 2:  # most nodes are correlated at a coarser scale
        monkeypatch.setattr(candidates, "_LARGEST_BOX", 60)
        monkeypatch.setattr("oracle.candidates.LARGEST_BOX", 60)
    settings = config(
        "verified",
        num_history=seed % 4,
        pixel_sizes=((0.25,), (0.5, 0.25), (0.45, 0.15))[seed % 3],
        max_speed=(None, 6.0)[seed % 5 == 0],
        significance=(0.0, 1.0, 2.0)[seed % 3],
        max_object_length=(None, 4.0)[seed % 3 > 0],
        min_height=(None, 0.3)[seed % 7 > 0],
    )
    window = scene(300 + seed, num_history=seed % 4, poses=seed % 5 > 0, stamps=seed % 2 > 0)
    bins = flow_as_oracle(window, settings).confidence.unique()
    assert len(bins) >= 6, "unlinked, static and moving points"


def test_the_preset_equals_the_oracle():
    settings = make_config("default", point_cloud_range=MODEL.point_cloud_range)
    assert flow_as_oracle(turning_car(5, settings.num_history, 0.5), settings).residual_flow.any()


@pytest.mark.parametrize(("region", "count"), [(NEAR, 2), pytest.param(WIDER, 3, marks=pytest.mark.slow)])
def test_a_part_of_real_drives_equals_the_oracle(av2_folder, kitti_file, data_root, region, count):
    settings = make_config("default", point_cloud_range=region)
    windows = [window_of(AV2Log(av2_folder), 0)]
    with HDF5Log(kitti_file) as kitti, HDF5Log(data_root / "av2-crown" / "av2-crown.h5") as crown:
        windows += [window_of(kitti, 9, 4), window_of(crown, len(crown) - 2, 4)]
    for window in windows[-count:]:
        moves = flow_as_oracle(untimed(window), settings).residual_flow.norm(dim=1) >= 0.05
        assert moves.sum() > 500  # there is something to find


def test_a_turning_car_moves_and_all_else_is_static():
    window, (start, velocity, rotation) = turning_car(7, 2), car_of(7)
    (result,) = VerifiedFlow(MODEL.replace(num_history=2))([window])
    points = window.pc0.points[:, :2].astype(np.float64)
    arm = points - start
    truth = velocity + rotation * np.stack((-arm[:, 1], arm[:, 0]), 1)
    is_car = (np.abs(arm) < 2.4).all(1) & (window.pc0.points[:, 2] > -1.4) & ~window.pc0.is_ground
    error = np.linalg.norm(result.residual_flow.numpy()[is_car, :2] - truth[is_car], axis=1)
    is_static = ~is_car & (points[:, 1] > -5.0)  # neither the person nor the wall beside
    assert error.mean() < 0.03
    assert result.residual_flow[is_static].any(1).sum() < 0.02 * is_static.sum()


def test_a_wall_that_seems_to_slide_is_static(monkeypatch):
    # Its samples stand still in the frame of a sensor that drives 1.4 m.
    rng = np.random.default_rng(0)
    wall = np.stack((rng.uniform(-4, 4, 250), np.full(250, 3.05), rng.uniform(-1, 1, 250)), 1)
    window = Window(Sweep(wall - (1.4, 0.0, 0.0)), Sweep(wall))
    assert not flow_as_oracle(window, MODEL).residual_flow.any()

    def nothing_slides(*given):
        return torch.zeros(given[3].shape[:2], dtype=torch.bool)

    without = partial(paired_test.verify, slides=nothing_slides)
    monkeypatch.setattr(VerifiedFlow, "verify", staticmethod(without))
    monkeypatch.setattr(motion_margin, "_LEAST_LIKELY", 4 * (0.0,))
    assert (VerifiedFlow(MODEL)([window])[0].residual_flow[:, 0] > 1.0).any()


def test_objects_longer_than_the_limit_are_static():
    # An L of 6 m x 5 m that moves by (0.5, 0.25) m; exactly 6 m is not longer.
    rng = np.random.default_rng(2)
    long_side = np.stack((np.full(900, 0.05), rng.uniform(0.0, 5.999, 900), rng.uniform(-1, 1, 900)), 1)
    ell = np.concatenate((long_side, long_side[:, [1, 0, 2]] * (5 / 6, 1, 1)))
    window = Window(Sweep(ell - (0.5, 0.25, 0.0)), Sweep(ell))
    settings = MODEL.replace(pixel_sizes=(0.25,), max_object_length=6.0)
    assert (flow_as_oracle(window, settings).residual_flow - torch.tensor([0.5, 0.25, 0])).norm(dim=1).max() < 0.05
    assert not flow_as_oracle(window, settings.replace(max_object_length=5.9)).residual_flow.any()


def test_speed_is_bounded_at_every_pixel_size():
    # Half of the box allows 2 m, the speed 0.6 m and a pixel.
    car = upright_box((0.0, 0.0), (4.0, 1.8), 0.0, np.random.default_rng(0))
    window = Window(Sweep(car - (1.7, 0.0, 0.0)), Sweep(car))
    free, bounded = (
        flow_as_oracle(window, MODEL.replace(max_speed=speed)).residual_flow[:, 0].max() for speed in (None, 6.0)
    )
    assert free > 1.6 and bounded <= 0.6 + 0.4 + 0.2


VELOCITY = (5.0, 1.5)  # m/s


def uneven_drive(times, stamped: bool = True) -> Window:
    """A car at some times before t+1, milliseconds, sampled anew; the flow t -> t+1 is VELOCITY times the first."""
    rng, sweeps = np.random.default_rng(0), []
    for time in [0, *times]:
        car = upright_box(-np.array(VELOCITY) * time / 1000, (3.6, 1.7), 0.0, rng, 220).astype(np.float32)
        sweeps.append(Sweep(car, timestamp_ns=10**12 - time * 10**6 if stamped else None))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def mean_error(window: Window, first: int) -> float:
    region = (-10.0, -4.0, -3.0, 6.0, 4.0, 3.0)
    result = flow_as_oracle(window, MODEL.replace(num_history=4, pixel_sizes=(0.2,), point_cloud_range=region))
    truth = torch.tensor([*VELOCITY, 0.0]) * first / 1000
    return float((result.residual_flow - truth).norm(dim=1).mean())


@pytest.mark.parametrize("times", [(100, 300, 400), (50, 150, 250, 350), (120, 200, 310, 395, 510)])
def test_time_stamps_give_the_times_of_sweeps(times):
    assert mean_error(uneven_drive(times), times[0]) < 0.03
    assert mean_error(uneven_drive(times, stamped=False), times[0]) > 0.06  # places say t-1, t-2, ...


REGION = (-8.0, -6.0, -math.inf, 8.0, 6.0, math.inf)
SIZE = (3.6, 1.6)


def crossing(x: float, speed: float, num_history: int) -> Window:
    """A car whose middle is at x at t, and a post that stands; the car's points come first."""
    sweeps = []
    for k in range(-1, num_history + 1):
        car = upright_box((x - k * speed, 0.5), SIZE, 0.0, np.random.default_rng(10 + k), 240)
        post = upright_box((-3.0, -4.0), (0.8, 0.8), 0.0, np.random.default_rng(20), 60)
        sweeps.append(Sweep(np.concatenate((car, post)).astype(np.float32)))
    newest, own, *older = sweeps
    return Window(own, newest, tuple(older))


@pytest.mark.parametrize(("where", "speed"), [(6.4, 1.4), (7.6, 1.4), (7.6, -1.2), (9.0, -1.2)])
def test_an_object_that_crosses_the_border_has_its_true_motion(where, speed):
    settings = make_config("default", point_cloud_range=REGION)
    window = crossing(where, speed, settings.num_history)
    result = flow_as_oracle(window, settings)
    inside = torch.as_tensor(np.abs(window.pc0.points[:, 0]) <= 8.0)
    assert torch.equal(result.is_valid, inside) and 0 < int(inside[:240].sum()) < 240
    error = (result.residual_flow[:240] - torch.tensor([speed, 0.0, 0.0])).norm(dim=1)[inside[:240]]
    assert (error < 0.1).double().mean() > 0.8 and error.max() < 0.25  # a part may be off by two pixels
    assert not result.residual_flow[240:].any()


def test_points_in_the_margin_have_no_result():
    settings = make_config("default", point_cloud_range=REGION)
    result = VerifiedFlow(settings)([crossing(10.2, 1.4, settings.num_history)])[0]
    for values, none in ((result.is_valid, 0), (result.residual_flow, 0), (result.score, 0), (result.confidence, 0)):
        assert not (values[:240] != none).any()
    assert (result.cluster_id[:240] == -1).all() and result.is_valid[240:].all()


def test_the_margin_does_not_shift_the_pixels_of_the_region():
    for sizes in ((0.4, 0.2, 0.1), (0.25,), (3.0,)):
        settings = make_config("default", pixel_sizes=sizes, point_cloud_range=REGION)
        for size in sizes:
            grid = VerifiedFlow(settings).grid(size)
            wide = (REGION[0] - grid.lower[0]) / sizes[0]
            assert wide == pytest.approx(round(wide)) and wide * sizes[0] >= 4.0 > (wide - 1) * sizes[0]
