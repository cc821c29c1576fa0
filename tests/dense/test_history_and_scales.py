"""What history and coarse to fine are for, and that bounded memory changes nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import assert_same, config, scene

from cflow_torch import CorrelationFlow, Sweep, Window, make_config
from cflow_torch.dense.correlation import best_shifts
from cflow_torch.dense.packing import Images


def car(rng: np.random.Generator, x: float, seen: float = 4.5) -> np.ndarray:
    """(N, 3) rear and the first metres `seen` of the right side of a car, as a LiDAR behind it sees them."""
    rear = np.stack([np.zeros(400), rng.uniform(0, 1.8, 400), rng.uniform(0, 1.4, 400)], 1)
    side = np.stack([rng.uniform(0, seen, 700), np.zeros(700), rng.uniform(0, 1.4, 700)], 1)
    return np.concatenate((rear, side)) + rng.normal(0, 0.01, (1100, 3)) + (x, 8.0, 0.0)


def error(sweeps: list, truth: tuple, **overrides) -> float:
    """Mean end-point error of the points of sweep t; `sweeps` from t+1 back."""
    window = Window(Sweep(sweeps[1]), Sweep(sweeps[0]), tuple(Sweep(sweep) for sweep in sweeps[2:]))
    (result,) = CorrelationFlow(make_config("paper", **overrides))([window])
    return float((result.residual_flow - torch.tensor(truth)).norm(dim=1).mean())


@pytest.mark.parametrize("num_history", [0, 2, 4])
@pytest.mark.parametrize("scales", [(0.4, 0.2, 0.1), (0.8, 0.4, 0.3, 0.2, 0.1)])
def test_coarse_levels_help_a_car_whose_footprints_do_not_overlap(num_history, scales):
    # 30 m/s are 3 m a sweep. Two metres of the car are seen, so a metre lies between its footprints.
    rng = np.random.default_rng(0)
    sweeps = [car(rng, 20.0 - 3.0 * k, seen=2.0) for k in range(num_history + 2)]
    truth = (3.0, 0.0, 0.0)
    assert error(sweeps, truth, num_history=num_history) == pytest.approx(3.0)  # 0.1 m pixels do not connect them
    assert error(sweeps, truth, num_history=num_history, pixel_sizes=scales) < 0.1


def test_history_measures_motion_below_a_pixel():
    # 0.4 m/s are 0.04 m a sweep: a pair of sweeps can only say 0 or 0.1 m, five sweeps see it move two pixels.
    rng = np.random.default_rng(1)
    sweeps = [car(rng, 10.0 - 0.04 * k) for k in range(6)]
    truth = (0.04, 0.0, 0.0)
    assert error(sweeps[:2], truth) > 0.035
    assert error(sweeps, truth, num_history=4) < 0.02


def test_a_shorter_history_is_fewer_estimates():
    window = scene(5, num_history=4)
    for length in range(5):
        shorter = Window(window.pc0, window.pc1, window.pch[:length])
        exact = CorrelationFlow(config(num_history=length))([shorter])[0]
        assert_same(CorrelationFlow(config(num_history=4))([shorter])[0], exact)


@pytest.mark.parametrize("max_memory", [1, 200_000, 2_000_000, 10**9])
@pytest.mark.parametrize("overrides", [{}, {"pixel_sizes": (0.5, 0.25), "sectional_view": True, "max_speed": 8.0}])
def test_max_memory_changes_no_bit(max_memory, overrides):
    windows = [scene(seed, num_history=seed % 4) for seed in range(5)]
    whole = CorrelationFlow(config(num_history=3, **overrides))(windows)
    chunked = CorrelationFlow(config(num_history=3, max_memory=max_memory, **overrides))(windows)
    for a, b in zip(whole, chunked):
        assert_same(a, b)


@pytest.mark.parametrize("engine", ["fft", "conv"])
def test_jobs_in_turn_give_the_same_shifts(engine):
    rng = np.random.default_rng(2)
    targets, jobs_per_target, side = 7, 3, 20
    target_of_job = torch.arange(targets).repeat_interleave(jobs_per_target)
    template = Images(*torch.from_numpy(rng.integers(0, (targets * jobs_per_target, side, side), (900, 3)).T))
    target = Images(*torch.from_numpy(rng.integers(0, (targets, side, side), (500, 3)).T))
    size = torch.full((targets, 2), side)
    expected = best_shifts(template, target, target_of_job, size, engine=engine)
    for max_memory in (1, 300_000, 10**9):
        found = best_shifts(template, target, target_of_job, size, engine=engine, max_memory=max_memory)
        assert torch.equal(found[0], expected[0]) and torch.equal(found[1], expected[1])


def test_presets():
    paper, default, fast = (make_config(name) for name in ("paper", "default", "fast"))
    assert (paper.pixel_sizes, paper.num_history, paper.sectional_view) == ((0.1,), 0, False)
    assert paper.point_cloud_range[:2] == (-35.0, -35.0) and paper.max_speed is None
    assert (default.pixel_sizes, default.num_history) == ((0.4, 0.2, 0.1), 4)
    assert len(fast.pixel_sizes) == 1 and 0 < fast.num_history < default.num_history
