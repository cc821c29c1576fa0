"""HDBSCAN in place of components equals the oracle; without the extra the message says what to install."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from oracle import reference_flow
from scenes import assert_same, assert_same_bits, config, scene

from cflow_torch import CFlowError, CorrelationFlow, Sweep, Window

SETTINGS = [
    {"num_history": 2, "pixel_sizes": (0.5, 0.25)},
    {"num_history": 1, "sectional_view": True, "max_speed": 5.0},
]


@pytest.mark.parametrize("overrides", SETTINGS, ids=["scales", "sectional"])
def test_equals_the_oracle_in_a_batch(overrides):
    pytest.importorskip("hdbscan")
    settings, nothing = config(clustering="hdbscan", min_cluster_size=8, **overrides), Sweep(np.zeros((0, 3)))
    windows = [scene(seed, num_history=settings.num_history) for seed in range(2)] + [Window(nothing, nothing)]
    model = CorrelationFlow(settings)
    for window, result in zip(windows, model(windows)):
        assert_same_bits(model([window])[0], result)
        assert_same(result, reference_flow(window, settings))


def test_too_few_points_form_no_cluster():
    few = Sweep(np.random.default_rng(0).uniform(0, 1, (8, 3)))
    (result,) = CorrelationFlow(config(clustering="hdbscan"))([Window(few, few)])
    assert (result.cluster_id == -1).all() and result.is_valid.all()


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "hdbscan", None)
    with pytest.raises(CFlowError, match=r"pip install hdbscan"):
        CorrelationFlow(config(clustering="hdbscan"))([scene(0)])
