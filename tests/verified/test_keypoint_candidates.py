"""Key points as motion candidates: what they are for."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import config

from cflow_torch import Sweep, Window, make_model


def test_they_find_what_moves_farther_than_it_is_long():
    # The correlation searches half of the box of both sweeps together. A post 0.7 m wide moves 1.2 m, beyond its gap.
    rng = np.random.default_rng(0)
    post = rng.uniform((-0.35, -0.35, -1.0), (0.35, 0.35, 1.0), (600, 3)) + (0.05, 0.05, 0.0)
    window = Window(Sweep(post - (1.2, 0.0, 0.0)), Sweep(post))
    flows = []
    for thorough in (False, True):
        settings = config("verified", pixel_sizes=(0.4, 0.1), thorough=thorough)
        flows.append(make_model(settings)([window])[0].residual_flow[:, 0].median().item())
    assert flows[0] < 1.0 and flows[1] == pytest.approx(1.2, abs=0.03)
