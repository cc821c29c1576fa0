"""Flow along the ground: slopes equal the oracle's; a car on a ramp climbs, unknown and steep ground give no z."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from oracle.height_slices import ground_slope
from preset_windows import changed
from turning_car import MODEL, REGION, turning_car

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ground_heights import GroundHeights


def slopes(points: np.ndarray, centres: np.ndarray) -> torch.Tensor:
    """(5, 2), which are the oracle's, whatever the order of the points."""
    found, window = [], torch.zeros(len(centres), dtype=torch.int64)
    for order in (slice(None), slice(None, None, -1)):
        heights = GroundHeights(1, Grid(0.1, REGION[:3], REGION[3:]), torch.device("cpu"))
        heights.add(0, torch.from_numpy(points[order].T.copy()))
        found.append(heights.slopes(torch.from_numpy(centres), window))
    assert torch.equal(*found)
    expected = [ground_slope(points, (x, y), MODEL) for x, y in centres.tolist()]
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    return found[0]


def test_slopes_equal_the_oracle_in_any_order():
    known = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-8, 8, (int(rng.integers(20, 500)), 3))
        points[:, 2] = points[:, :2] @ rng.normal(0, 0.15, 2) + rng.normal(0, 0.03, len(points)) - 1.7
        points[: len(points) // 5, 2] += rng.uniform(0, 0.5)
        points = points[(np.abs(points[:, 2] - 1) <= 4) & (points[:, 0] < rng.uniform(-4, 9))]
        known += int(slopes(points, rng.uniform(-9, 9, (5, 2))).any(1).sum())
    assert 20 < known < 130


def test_rough_ground_equals_the_oracle():
    # Of rough ground, few blocks are near a plane: too few of them, or on a line.
    for seed in range(100):
        rng = np.random.default_rng(seed)
        points = rng.uniform(-8, 8, (300, 3))
        points[:, 2] = rng.normal(0, 0.2, (9, 9))[tuple((points[:, :2] // 2).astype(int).T)] - 1.7
        slopes(points, rng.uniform(-6, 6, (5, 2)))


def on_a_ramp(window: Window, slope: float) -> Window:
    def tilted(sweep: Sweep) -> Sweep:
        points = sweep.points.copy()
        points[:, 2] += slope * points[:, 0]
        return replace(sweep, points=points)

    return changed(window, tilted)


@pytest.mark.parametrize("slope, z_of_x", [(0.05, 0.05), (0.0, 0.0), (0.4, 0.0)])
def test_moving_objects_climb_a_ramp_and_static_points_do_not(slope, z_of_x):
    model = VerifiedFlow(MODEL.replace(point_cloud_range=(*REGION[:2], -9.0, *REGION[3:5], 9.0)))
    flow = model([on_a_ramp(turning_car(3), slope)])[0].residual_flow
    is_moving = flow[:, :2].any(1)
    assert is_moving.any() and not flow[~is_moving].any()
    assert (flow[is_moving, 2] - z_of_x * flow[is_moving, 0]).abs().max() < 0.01


def test_without_ground_there_is_no_vertical_flow():
    bare = changed(
        on_a_ramp(turning_car(3), 0.05),
        lambda sweep: Sweep(sweep.points[~sweep.is_ground]),
    )
    flow = VerifiedFlow(MODEL)([bare])[0].residual_flow
    assert flow[:, :2].any() and not flow[:, 2].any()
