"""De-skewing puts a car together again that its motion has torn apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scenes import pose

from cflow_torch import CFlowError, FlowResult, Sweep, VerifiedFlow, Window
from cflow_torch.windows.deskewing import deskew_objects

LENGTH, STEP = 4.5, 2.0  # metres, metres per sweep


def torn_car(yaw: float) -> Window:
    """A car that two LiDARs measure half a sweep apart, and a wall; the vehicle rotates by `yaw` a sweep."""
    rng = np.random.default_rng(0)
    sweeps = []
    for k in range(4):  # t+1, t, t-1, t-2
        side = np.stack((rng.uniform(0, LENGTH, 600), np.full(600, 4.0), rng.uniform(0, 1.5, 600)), 1)
        back = np.stack((np.zeros(200), rng.uniform(4, 5.8, 200), rng.uniform(0, 1.5, 200)), 1)
        wall = np.stack((rng.uniform(-20, 20, 800), np.full(800, 9.0), rng.uniform(0, 2.5, 800)), 1)
        times = np.repeat((0.01, 0.06), 800)[rng.permutation(1600)]
        car = np.concatenate((side, back)) - (k * STEP, 0, 0)
        points = np.concatenate((car + np.outer(times[:800], (STEP / 0.1, 0, 0)), wall))
        T_world_ego = pose(-1.0 * k, 0, -yaw * k)
        points = (points - T_world_ego[:3, 3]) @ T_world_ego[:3, :3]
        sweeps.append(Sweep(points, pose=T_world_ego, timestamp_ns=10**9 - k * 10**8, point_times=times))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def in_world(points: np.ndarray, sweep: Sweep) -> np.ndarray:
    return points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]


@pytest.mark.parametrize("yaw", [0.0, 0.1])
def test_a_torn_car_is_put_together(yaw: float) -> None:
    window = torn_car(yaw)
    (result,) = VerifiedFlow.from_preset("default", device="cpu")([window])
    whole = in_world(deskew_objects(window, result).numpy(), window.pc0)
    given = in_world(window.pc0.points, window.pc0)
    assert np.ptp(given[:800, 0]) > LENGTH + 0.9 and abs(np.ptp(whole[:800, 0]) - LENGTH) < 0.1
    assert abs(whole[:800, 0].min() + STEP) < 0.05, "its position at the time stamp of the sweep"
    assert np.array_equal(whole[800:], given[800:])


def test_each_point_moves_back_by_its_share_of_the_flow() -> None:
    window = torn_car(0.3)
    flow = torch.rand(1600, 3, generator=torch.Generator().manual_seed(0))
    moved = deskew_objects(window, FlowResult.of({"residual_flow": flow})).numpy() - window.pc0.points
    rotation = window.pc0.pose[:3, :3].T @ window.pc1.pose[:3, :3]
    assert np.allclose(moved, -(flow.numpy() @ rotation.T) * (window.pc0.point_times / 0.1)[:, None], atol=1e-12)
    # The method takes the interval from time stamps if all sweeps have one, and so do we.
    unstamped = replace(window, pch=tuple(replace(sweep, timestamp_ns=None) for sweep in window.pch))
    slower = deskew_objects(unstamped, FlowResult.of({"residual_flow": flow}), 0.2).numpy() - window.pc0.points
    with pytest.raises(CFlowError, match="is not a positive"):
        deskew_objects(unstamped, FlowResult.of({"residual_flow": flow}), 0.0)
    assert len(window.pch) > 0 and np.allclose(2 * slower, moved, atol=1e-12)
    still = replace(window, pc0=replace(window.pc0, point_times=np.zeros(1600)))
    assert np.array_equal(deskew_objects(still, FlowResult.of({"residual_flow": flow})), window.pc0.points)


@pytest.mark.parametrize(
    "change, rows, message",
    [
        ({"point_times": None}, 1600, "no times of points"),
        ({}, 3, "of each of the 1600 points"),
        ({"timestamp_ns": 2 * 10**9}, 1600, "out of order"),
    ],
)
def test_unusable_inputs_are_refused(change: dict, rows: int, message: str) -> None:
    window = torn_car(0.0)
    window = replace(window, pc0=replace(window.pc0, **change))
    with pytest.raises(CFlowError, match=message):
        deskew_objects(window, FlowResult.of({"residual_flow": torch.zeros(rows, 3)}))
