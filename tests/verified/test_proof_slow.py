"""Slow and large groups in the proof as a whole: the reference's bits, and that both parts have a say."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracle import nudge as ref
from oracle import reference_flow
from test_nudge import car
from test_proof import ALL
from test_slow import person

from cflow_torch import Config, CorrelationFlow, Sweep, Window


def window_of_both(seed: int) -> Window:
    """A person at 0.07 m a sweep, a car at half a metre, each sampled anew."""
    rng = np.random.default_rng(seed)
    sweeps = []
    for k in (0, 1):
        parts = [person((0.05 * k + 4.0, 0.05 * k), rng), car((0.53 * k - 3.0, 0.07 * k), rng, 600)]
        sweeps.append(Sweep(np.concatenate(parts).astype(np.float32)))
    return Window(pc0=sweeps[0], pc1=sweeps[1])


@pytest.mark.parametrize("part", ["slow", "nudge"])
def test_equals_the_reference_and_matters(part, monkeypatch):
    monkeypatch.setattr("cflow_torch.verified.nudge._LEAST_CUBES", 40)
    monkeypatch.setattr(ref, "LEAST_CUBES", 40)
    differs = 0
    for seed in range(4):
        window, settings = window_of_both(seed), Config(**ALL)
        (result,) = CorrelationFlow(settings)([window])
        assert torch.equal(result.residual_flow, reference_flow(window, settings).residual_flow)
        (without,) = CorrelationFlow(settings.replace(**{part: False}))([window])
        differs += int(not torch.equal(result.residual_flow, without.residual_flow))
    assert differs > 0
