"""Vertical motion from the sectional view: known answers, which the oracle gives as well."""

from __future__ import annotations

import math

import numpy as np
import pytest
import scenes
import torch
from scenes import config

from cflow_torch import CFlowError, CorrelationFlow, FlowResult, Sweep, Window

METRE = config(pixel_size=1.0, point_cloud_range=(0.0, 0.0, -math.inf, 40.0, 40.0, math.inf), max_extent=1000.0)
SECTIONAL = METRE.replace(sectional_view=True)


def flow_as_oracle(pc0: np.ndarray, pc1: np.ndarray, settings=SECTIONAL) -> FlowResult:
    return scenes.flow_as_oracle(Window(Sweep(pc0), Sweep(pc1)), settings)


@pytest.mark.parametrize("move", [(3, 4, 1), (-4, 3, -2), (0, 2, 1), (0, 0, 2), (3, 0, 0)])
def test_a_vertical_move_is_found(move):
    ell = np.array(
        [(c + 0.5, r + 0.5, 0.5) for r, c in [(r, 10) for r in range(10, 22)] + [(21, c) for c in range(11, 22)]]
    )
    points = np.concatenate([ell + [0, 0, z] for z in range(6)])
    result, flat = flow_as_oracle(points, points + move), flow_as_oracle(points, points + move, METRE)
    np.testing.assert_allclose(result.residual_flow, np.tile(move, (len(points), 1)), atol=1e-6)
    assert flat.residual_flow.tolist() == [[*map(float, move[:2]), 0.0]] * len(points)
    assert torch.equal(flat.score, result.score)


def test_motion_along_the_heading_is_corrected():
    # 0.8 -> 1.2: the same BEV pixel, as its grid starts at -0.25; the grid of the section starts at 0.
    settings = SECTIONAL.replace(point_cloud_range=(-0.25, 0.0, -math.inf, 20.0, 20.0, math.inf))
    before = np.array([[0.8 + i, 5.5, 0.5] for i in range(4)])
    after = before + [0.4, 0, 0]
    assert flow_as_oracle(before, after, settings).residual_flow.tolist() == [[1.0, 0.0, 0.0]] * 4
    assert not flow_as_oracle(before, after, settings.replace(sectional_view=False)).residual_flow.any()


def test_a_point_far_above_is_refused_with_a_hint():
    car = np.random.default_rng(0).uniform((5, 5, 0), (9, 7, 1.5), (300, 3))
    car[7, 2] = 1e5
    with pytest.raises(CFlowError, match="finite z bounds"):
        CorrelationFlow(SECTIONAL)([Window(Sweep(car), Sweep(car + [2.0, 0.0, 0.0]))])
