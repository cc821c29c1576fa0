"""The conventions that users rely on: frames, units, rows, dtypes, ties; one test each."""

from __future__ import annotations

import math
from typing import Any, List, Tuple

import numpy as np
import pytest
import torch

from cflow_torch import CorrelationFlow, FlowResult, Sweep, Window, estimate_flow

INF = math.inf
# Pixels of 1 m and points in their middles: displacements are exact. The paper's method, one pair, one scale.
SETTINGS = {"preset": "paper", "pixel_size": 1.0, "point_cloud_range": (-20.0, -20.0, -INF, 20.0, 20.0, INF)}
# (row, column) pixels of an L, 6 m along y and 5 m along x.
ELL = [(r, 0) for r in range(6)] + [(5, c) for c in range(1, 5)]


def points_of(pixels: List[Tuple[int, int]]) -> np.ndarray:
    """(N, 3) a point in the middle of each (row, column); pixel (0, 0) begins at x = y = 0."""
    return np.array([(c + 0.5, r + 0.5, 0.5) for r, c in pixels]).reshape(-1, 3)


def ell(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    """(10, 3) an L of pixels, moved."""
    return points_of(ELL) + [x, y, z]


def transform(yaw: float, x: float, y: float) -> np.ndarray:
    """(4, 4) a turn by `yaw` degrees, counter-clockwise, then a shift."""
    cos, sin = round(math.cos(math.radians(yaw)), 12), round(math.sin(math.radians(yaw)), 12)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def through(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, 3) T p."""
    return points @ T[:3, :3].T + T[:3, 3]


def flow_of(pc0: Any, pc1: Any, **arguments: Any) -> FlowResult:
    return estimate_flow(pc0, pc1, **{**SETTINGS, **arguments})


def flow_of_window(window: Window, **overrides: Any) -> FlowResult:
    settings = {**SETTINGS, **overrides}
    (result,) = CorrelationFlow.from_preset(**settings)([window])
    return result


# --------------------------------------------------------------------------------------------- frames and units


def test_poses_map_the_ego_frame_to_the_world():
    pose0, pose1, world = transform(90, 3, 1), transform(0, 5, 2), ell(6, 3)
    sweeps = [Sweep(through(np.linalg.inv(pose), world), pose=pose) for pose in (pose0, pose1)]
    result = flow_of_window(Window(*sweeps))
    assert not result.residual_flow.any() and result.score.tolist() == [1.0] * 10
    np.testing.assert_allclose(result.pose_flow, sweeps[1].points - sweeps[0].points, atol=1e-6)


def test_flow_has_the_axes_of_t1():
    T_ego1_ego0 = transform(-90, 0, 0)  # the vehicle turns left by 90 degrees; its world turns right
    pc0, ahead = ell(4), np.array([2.0, 0, 0])  # what was ahead at t is on the right at t+1
    result = flow_of(pc0, through(T_ego1_ego0, pc0 + ahead), T_ego1_ego0=T_ego1_ego0)
    assert result.residual_flow.tolist() == [[0, -2, 0]] * 10


def test_time_stamps_are_nanoseconds_and_speeds_metres_per_second():
    found = {}
    for milliseconds in (100, 300):
        window = Window(Sweep(ell(), timestamp_ns=0), Sweep(ell(2), timestamp_ns=milliseconds * 1_000_000))
        # 5 m/s: 0.5 m + one pixel in 0.1 s, 1.5 m + one pixel in 0.3 s
        found[milliseconds] = flow_of_window(window, max_speed=5.0).residual_flow[0, 0].item()
    assert found[100] < 2 and found[300] == 2


# --------------------------------------------------------------------------------------------------------- rows


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_dtypes_of_the_result(dtype):
    result = flow_of(ell().astype(dtype), torch.from_numpy(ell(2).astype(dtype)))
    assert result.residual_flow[0].tolist() == [2, 0, 0]
    assert {name: str(value.dtype) for name, value in result.numpy().items()} == {
        "residual_flow": "float32",
        "pose_flow": "float32",
        "flow": "float32",
        "cluster_id": "int64",
        "score": "float32",
        "is_valid": "bool",
    }


# ----------------------------------------------------------------------------------------------------- clusters


# -------------------------------------------------------------------------------------------------- correlation


def test_the_score_is_the_normalised_correlation():
    assert flow_of(ell(), ell(2)).score.tolist() == [1.0] * 10
    half = flow_of(ell(), ell()[:5])  # 5 of 10 pixels are there: 5 / sqrt(10 * 5)
    np.testing.assert_allclose(half.score, math.sqrt(0.5), rtol=1e-6)
