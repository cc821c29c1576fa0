"""History whose sweeps are not evenly apart: the proof goes by time stamps where it is told to."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import as_scene
from oracle import reference_flow
from scenes import assert_same

from cflow_torch import CFlowError, Config, CorrelationFlow, Sweep, Window
from cflow_torch.config import PRESETS, make_config
from cflow_torch.verified.rigid_registration import refine

PROOF = {
    "proof": True,
    "pixel_sizes": (0.2,),
    "num_history": 4,
    "point_cloud_range": (-10.0, -4.0, -3.0, 6.0, 4.0, 3.0),
    "yaw": True,
}
VELOCITY = (5.0, 1.5)  # m/s


def drive(times, stamped=True) -> Window:
    """A car at some times before t+1, milliseconds, sampled anew; the flow t -> t+1 is VELOCITY times the first."""
    rng, sweeps = np.random.default_rng(0), []
    for time in [0, *times]:
        side, along = rng.integers(0, 4, 220), rng.uniform(-0.5, 0.5, 220)
        x = np.where(side < 2, along, np.where(side == 2, -0.5, 0.5)) * 3.6
        y = np.where(side >= 2, along, np.where(side == 0, -0.5, 0.5)) * 1.7
        xy = np.stack((x, y), 1) - np.array(VELOCITY) * time / 1000
        points = np.concatenate((xy, rng.uniform(-1.0, 0.4, (220, 1))), 1)
        sweeps.append(Sweep(points.astype(np.float32), timestamp_ns=10**12 - time * 10**6 if stamped else None))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def error(window: Window, first: int, **overrides) -> float:
    """Mean error in metres, and the result is that of the reference."""
    config = Config(**{**PROOF, **overrides})
    (result,) = CorrelationFlow(config)([window])
    assert_same(result, reference_flow(window, config))
    truth = torch.tensor([*VELOCITY, 0.0]) * first / 1000
    return float((result.residual_flow - truth).norm(dim=1).mean())


@pytest.mark.parametrize(
    "times", [(100, 300, 400), (100, 350, 450), (50, 150, 250, 350), (120, 200, 310, 395, 510), (100, 300)]
)
def test_time_stamps_are_heeded(times):
    window = drive(times)
    assert error(window, times[0], use_timestamps=True) < 0.03
    assert error(window, times[0], use_timestamps=False) > 0.06  # steps say t-1, t-2, ...


def test_a_long_gap_needs_time_stamps():
    window = drive((100, 400))
    assert error(window, 100, use_timestamps=True) < 0.03
    with pytest.raises(CFlowError, match="use_timestamps=True"):
        CorrelationFlow(Config(**PROOF))([window])


@pytest.mark.parametrize("stamped", [True, False])
def test_even_or_missing_time_stamps_change_no_bit(stamped):
    window = drive((100, 200, 300), stamped)
    by_steps, by_time = (CorrelationFlow(Config(**PROOF, use_timestamps=u))([window])[0] for u in (False, True))
    assert_same(by_steps, by_time)


def test_jitter_leaves_the_second_sweep_to_the_refinement():
    # The group starts 0.08 m off. A clock that is 0.3 ms late must not cost half of the pairs.
    rng = np.random.default_rng(1)
    shape = rng.uniform(-0.8, 0.8, (300, 3))
    clouds = [shape - (0.5 * k, 0.0, 0.0) + rng.normal(0, 0.01, shape.shape) for k in range(3)]
    scene = as_scene(clouds, [np.array([0.42, 0.0])])

    def refined(elapsed):
        pixels, times = (scene.pixel_of_place, len(scene.group)), torch.tensor([elapsed], dtype=torch.float64)
        return refine(scene.moving(), *pixels, scene.grid, times, scene.flow).flow[0, 0].item()

    even, late, without = refined([0.0, 1.0, 2.0]), refined([0.0, 1.0, 2.003]), refined([0.0, 1.0, 0.0])
    assert abs(late - even) < 0.001
    assert abs(without - even) > 0.003


def test_presets_with_history_go_by_time_stamps():
    assert {name: make_config(name).use_timestamps for name in PRESETS} == {
        "paper": False,
        "default": True,
        "fast": True,
        "keypoints": False,
    }
