"""Sweeps after t+1 whose points have times: a car that comes out from behind something, seen by a sensor that rolls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from preset_windows import changed
from scenes import assert_same_bits, flow_as_oracle, reordered, rows_of
from turning_car import upright_box

from cflow_torch import FlowResult, Sweep, VerifiedFlow, Window, make_config

# Small enough for the oracle.
OFFLINE = make_config("offline", point_cloud_range=(-5.0, -3.0, -3.0, 4.0, 6.0, 3.0))
MODEL = VerifiedFlow(OFFLINE)
SPEED = 0.8  # metres per sweep, along -x
LATER = 0.12  # sweep intervals by which the car is met later in each sweep than in the one before


def rolling_drive(num_history: int = 1, num_future: int = 4) -> Window:
    """A car and a post, met by two units half a turn apart; the car comes out from behind something: a corner of its
    front is first seen at t. Seen as it stands, it seems to go LATER farther in each interval than it goes."""
    rng, sweeps = np.random.default_rng(3), []
    for k in range(-num_history, 2 + num_future):
        clouds, times = [upright_box((-2.0, 5.0), (0.4, 0.4), 0.0, rng, 60)], [rng.uniform(0, 1, 60)]
        for unit in (0.0, 0.5):
            time = LATER * k + unit - 0.4
            car = upright_box((3.0 - SPEED * (k + time), 0.0), (4.4, 1.8), 0.0, rng, 1000)
            clouds.append(car[car[:, 0] + 0.7 * car[:, 1] < 0.35])
            times.append(np.full(len(clouds[-1]), time))
        sweeps.append(Sweep(np.concatenate(clouds).astype(np.float32), point_times=0.1 * np.concatenate(times)))
    t = num_history
    return Window(sweeps[t], sweeps[t + 1], tuple(sweeps[:t][::-1]), tuple(sweeps[t + 2 :]))


def bare(window: Window) -> Window:
    return changed(window, lambda sweep: replace(sweep, point_times=None))


def error_of_car(window: Window, result: FlowResult) -> float:
    is_car = np.abs(window.pc0.points[:, 1]) < 2
    assert is_car.sum() > 50
    return float((result.residual_flow[is_car] - torch.tensor([-SPEED, 0.0, 0.0])).norm(dim=1).mean())


@pytest.mark.parametrize("num_history", [0, 1])
def test_a_mover_that_comes_out_and_is_stretched_has_its_motion(num_history):
    window = rolling_drive(num_history)
    past_only = replace(window, pcf=())
    error, without_times, without_future = (error_of_car(w, MODEL([w])[0]) for w in (window, bare(window), past_only))
    assert error < 0.03
    assert without_times == pytest.approx(LATER * SPEED, abs=0.03) and without_future > 0.5


def test_the_whole_method_equals_the_oracle():
    window = rolling_drive(1, 3)
    found = flow_as_oracle(window, OFFLINE)
    assert not torch.equal(found.residual_flow, MODEL([bare(window)])[0].residual_flow)


def test_alone_or_in_a_batch_in_any_order_of_points():
    windows: list[Window] = [rolling_drive(), bare(rolling_drive(0)), rolling_drive(1, 0), rolling_drive(0, 2)]
    for window, result in zip(windows, MODEL(windows)):
        assert_same_bits(MODEL([window])[0], result)
        mixed, order = reordered(window)
        assert_same_bits(MODEL([mixed])[0], rows_of(result, order))
