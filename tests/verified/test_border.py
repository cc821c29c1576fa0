"""The border of the region: what crosses it is seen whole, and only what lies inside has a result."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scenes import flow_as_oracle
from turning_car import upright_box

from cflow_torch import Sweep, VerifiedFlow, Window, make_config

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


@pytest.mark.parametrize("where", [6.4, 7.6, 9.0])
@pytest.mark.parametrize("speed", [1.4, -1.2])
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
