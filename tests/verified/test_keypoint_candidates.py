"""Key points as motion candidates: the oracle's matches, and what they are for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle
from oracle.candidates import keypoint_shifts
from scenes import config, scene, sweeps_of

from cflow_torch import Sweep, Window, make_model
from cflow_torch.verified.keypoint_candidates import match_key_points


@pytest.mark.parametrize("seed", range(3))
def test_matches_equal_the_oracle(seed):
    settings = config("verified", num_history=1, pixel_size=0.1, max_speed=(None, 6.0)[seed % 2])
    sweeps = sweeps_of([scene(40 + seed, num_history=1), scene(50 + seed)], settings)
    found = match_key_points(sweeps, settings)
    assert sweeps.step[found.pixel].eq(1).all()
    places = torch.stack((sweeps.window, sweeps.row, sweeps.col), 1)[found.pixel].tolist()
    mine = dict(zip(map(tuple, places), map(tuple, found.motion.tolist())))
    expected = {
        (window, r, c): shift
        for window in range(2)
        for (_, r, c), shift in keypoint_shifts(for_oracle(sweeps, window), settings).items()
    }
    assert mine == expected and len(expected) > 10


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
