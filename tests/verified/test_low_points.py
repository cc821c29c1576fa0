"""Low points that are not drawn move with a moving object near them. Others are static, but unknown beside one."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import flow_as_oracle
from turning_car import MODEL, turning_car

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.verified.confidence import TABLE
from cflow_torch.verified.low_points import find_low_points

STEP = 0.6  # metres that the car moves
LOW = slice(-16, None)  # the points of the low row come last
GROUND = np.mgrid[-6:6:0.2, -6:6:0.2].reshape(2, -1).T
# Metres in front of the car, and above the ground. The first row is a bumper, the second one a shadow on the ground.
ROWS = {"bumper": (0.4, 0.2), "ground": (0.4, 0.05), "beside": (1.0, 0.2), "far": (3.4, 0.2)}


def sweep_at(shift: float, rows: list[str]) -> Sweep:
    """A car that starts 0.5 m above the ground, and low rows of points in front of it."""
    ground = np.column_stack((GROUND, np.zeros(len(GROUND))))
    car = np.stack(np.meshgrid(np.arange(-3, 0.01, 0.1), np.arange(-0.8, 0.81, 0.1), np.arange(0.5, 1.5, 0.1)), -1)
    side = np.arange(-0.75, 0.8, 0.1)
    low = [np.column_stack((np.full(16, ROWS[row][0]), side, np.full(16, ROWS[row][1]))) for row in rows]
    objects = np.concatenate((car.reshape(-1, 3), *low)) + (shift, 0.03, 0)
    points = np.concatenate((ground, objects)).astype(np.float32)
    return Sweep(points, is_ground=np.arange(len(points)) < len(ground))


@pytest.mark.parametrize(("row", "moves"), [("bumper", True), ("ground", False), ("beside", False), ("far", False)])
def test_a_low_row_moves_with_the_car_behind_it(row, moves):
    window = Window(sweep_at(0.0, [row]), sweep_at(STEP, [row]))
    (result,) = VerifiedFlow(MODEL)([window])
    of_car = len(GROUND)  # the first point of the car
    assert abs(float(result.residual_flow[of_car, 0]) - STEP) < 0.1
    flow, cluster_id, moving = (each[LOW] for each in (result.residual_flow, result.cluster_id, result.moving))
    if moves:
        assert torch.allclose(flow, result.residual_flow[of_car], atol=0.01)
        assert (cluster_id == result.cluster_id[of_car]).all() and (moving == result.moving[of_car]).all()
    else:
        assert not flow.any() and (cluster_id == -1).all()
        assert torch.allclose(moving, torch.tensor(TABLE["moving"][int(row != "far")]))


def test_low_points_in_front_of_a_static_car_are_static():
    sweep = sweep_at(0.0, ["bumper"])
    (result,) = VerifiedFlow(MODEL)([Window(sweep, sweep_at(0.0, ["bumper"]))], warns=False)
    assert not result.residual_flow.any() and (result.cluster_id[LOW] == -1).all()


@pytest.mark.parametrize("num_history", [0, 2])
def test_equals_the_oracle_with_low_points(num_history, monkeypatch):
    counts = []

    def counted(*args):
        row, pixel = find_low_points(*args)
        is_beside = pixel > args[0].num_pixels
        counts.extend((int(is_beside.sum()), int((~is_beside).sum())))
        return row, pixel

    monkeypatch.setattr(VerifiedFlow, "find_low_points", staticmethod(counted))
    for seed in (1, 5):
        flow_as_oracle(turning_car(seed, num_history), MODEL.replace(num_history=num_history))
    assert min(counts) >= 1
