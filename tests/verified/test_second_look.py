"""The second look and local motion within the whole method: equal to the oracle, alone or in a batch, in any order."""

from __future__ import annotations

from typing import Tuple

import numpy as np
import pytest
import torch
from scenes import assert_same, assert_same_bits, flow_as_oracle, needs_gpu, reordered, rows_of
from turning_car import MODEL, upright_box

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified import method

SETTINGS: VerifiedConfig = MODEL.replace(num_history=3, num_future=4, point_cloud_range=(-7, -6, -3, 7, 6, 9))
WAY = 0.7  # metres per interval of the car, along x
WALKER = 0.12  # of the walker, along -x


def avenue(num_history: int = 0, num_future: int = 0, seed: int = 0, start: float = -1.0, first: int = -9) -> Window:
    """A car drives under the crown of a tree, a walker along a wall; another car drives beside, all in the open.

    Args:
        num_history, num_future: sweeps before t, after t+1.
        seed: of the points.
        start: x of both cars at t+1.
        first: sweep that shows the cars first, 0 = t+1, -1 = t.
    """
    rng, sweeps = np.random.default_rng(seed), []
    crown = rng.uniform((-4.5, -1.9, 2.2), (4.5, 1.9, 4.0), (1600, 3))
    for k in [0, -1, *range(-2, -2 - num_history, -1), *range(1, 1 + num_future)]:
        x = start + WAY * k
        parts = [
            upright_box((x, 0.0), (3.6, 1.7), 0.0, rng, 500 if k >= first else 0) * (1, 1, 0.6),
            upright_box((x, -4.0), (3.6, 1.7), 0.0, rng, 500 if k >= first else 0) * (1, 1, 0.6),
            crown + rng.normal(0.0, 0.01, crown.shape),
            rng.uniform((-6.0, 4.6, -1.0), (6.0, 4.8, 1.4), (1500, 3)),
            rng.uniform((-0.25, 4.1, -0.9), (0.25, 4.5, 0.9), (250, 3)) - (WALKER * k, 0.0, 0.0),
            rng.uniform((-6.5, -5.5, -1.0), (-6.2, -5.2, -0.2), (20, 3)),
        ]
        sweeps.append(Sweep(np.concatenate(parts).astype(np.float32)))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2 : 2 + num_history]), tuple(sweeps[2 + num_history :]))


def is_under_crown(window: Window) -> torch.Tensor:
    x, y, z = np.asarray(window.pc0.points).T
    return torch.from_numpy((np.abs(y) < 1.0) & (z < 1.5))


def error(window: Window, result, rows: torch.Tensor, truth: Tuple[float, float, float]) -> float:
    assert rows.sum() > 100
    return float((result.residual_flow[rows] - torch.tensor(truth)).norm(dim=1).mean())


@pytest.mark.parametrize(
    "num_history, num_future, start",
    [
        (0, 0, -1.0),
        (2, 0, -1.0),
        (3, 0, -6.0),
        (2, 0, 6.5),
        pytest.param(1, 4, -2.0, marks=pytest.mark.slow),
        (0, 3, -6.0),
    ],
)
def test_equals_the_oracle(num_history, num_future, start):
    window = avenue(num_history, num_future, start=start, seed=num_history)
    result = flow_as_oracle(window, SETTINGS)
    car = is_under_crown(window) & result.is_valid
    assert error(window, result, car, (WAY, 0.0, 0.0)) < 0.1


@pytest.mark.slow
def test_the_future_decides_for_what_a_second_look_finds():
    # Both cars appear at t: of the sweeps after t+1 four show each of them, of those before t none.
    window = avenue(3, 4, start=-2.0, first=-1)
    result = flow_as_oracle(window, SETTINGS)
    assert error(window, result, is_under_crown(window), (WAY, 0.0, 0.0)) < 0.1


def test_alone_or_in_a_batch_in_any_order_of_points():
    empty = Window(*[Sweep(np.full((3, 3), np.nan, np.float32))] * 2)
    windows = [
        avenue(2, 2, seed=1),
        empty,
        avenue(0, 0, seed=2),
        avenue(1, 0, seed=3, start=-6.0),
        avenue(0, 2, seed=4),
    ]
    model = VerifiedFlow(SETTINGS)
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
        mixed, order = reordered(window)
        assert_same_bits(model([mixed])[0], rows_of(result, order))


@pytest.mark.cuda
@needs_gpu
def test_cuda_equals_cpu():
    windows = [avenue(2, 2, seed=1), avenue(0, 0, seed=2), avenue(1, 0, seed=3, start=-6.0)]
    for on_cpu, on_gpu in zip(*(VerifiedFlow(SETTINGS, device)(windows) for device in ("cpu", "cuda"))):
        assert_same(on_gpu, on_cpu, atol=1e-4)


def test_a_car_under_a_crown_needs_the_second_look(monkeypatch):
    window, model = avenue(3), VerifiedFlow(SETTINGS)
    (whole,) = model([window])
    points = np.asarray(window.pc0.points)
    walker = torch.from_numpy((np.abs(points[:, 0]) < 0.5) & (points[:, 1] > 3.9) & (points[:, 1] < 4.55))
    assert error(window, whole, is_under_crown(window), (WAY, 0.0, 0.0)) < 0.05
    assert error(window, whole, walker, (-WALKER, 0.0, 0.0)) < 0.05
    monkeypatch.setattr(method, "points_of_lower_layers", lambda sweeps, at_rest: torch.zeros_like(at_rest))
    (without,) = model([window])
    assert error(window, without, is_under_crown(window), (WAY, 0.0, 0.0)) > 0.5
