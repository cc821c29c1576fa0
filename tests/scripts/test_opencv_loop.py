"""The OpenCV loop of the benchmark computes the flow of the paper's method."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from preset_windows import small
from scenes import RANGE, assert_same

from cflow_torch import CorrelationFlow, Sweep, Window, make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window

pytest.importorskip("cv2")
S = 0.25  # pixel of the small scenes
# (row, col, height, width) and the shift per sweep (rows, cols); objects do not touch within three sweeps.
OBJECTS = [((5, 5, 9, 6), (0, 1)), ((5, 30, 5, 9), (1, -1)), ((32, 8, 7, 7), (-1, 0)), ((35, 40, 12, 8), (0, 0))]


@pytest.fixture()
def loop(script: Any) -> Any:
    return script("benchmarks", "opencv_loop")


def ell(row: int, col: int, height: int, width: int) -> np.ndarray:
    """Points in the middle of the pixels of an L: its correlation has one peak."""
    pixels = [(r, 0) for r in range(height)] + [(height - 1, c) for c in range(1, width)]
    x = [RANGE[0] + (col + c + 0.5) * S for _, c in pixels]
    y = [RANGE[1] + (row + r + 0.5) * S for r, _ in pixels]
    return np.stack([x, y, np.linspace(0, 1, len(x))], 1)


def moving_ells(num_history: int) -> Window:
    def sweep(step: int) -> Sweep:
        """All objects `step` sweeps after t + 1."""
        return Sweep(np.concatenate([ell(r + step * v, c + step * u, h, w) for (r, c, h, w), (v, u) in OBJECTS]))

    return Window(sweep(-1), sweep(0), tuple(sweep(-2 - i) for i in range(num_history)))


def true_flow() -> np.ndarray:
    return np.concatenate([np.tile([u * S, v * S, 0.0], (h + w - 1, 1)) for (_, _, h, w), (v, u) in OBJECTS])


@pytest.mark.parametrize(
    "overrides", [{}, {"connectivity": 4}, {"num_history": 2}, {"num_history": 1, "pixel_sizes": (0.5, 0.25)}], ids=str
)
def test_the_loop_finds_shifts_by_whole_pixels(loop: Any, overrides: dict) -> None:
    settings = small("paper", **{"num_history": 0, **overrides})
    sweeps = moving_ells(settings.num_history)
    result = loop.opencv_flow(sweeps, settings)
    assert_same(result, CorrelationFlow(settings, "cpu")([sweeps])[0])
    if len(settings.pixel_sizes) == 1:
        np.testing.assert_allclose(result.residual_flow, true_flow(), rtol=0, atol=1e-6)


def test_the_loop_agrees_on_the_real_pair(loop: Any, av2_folder: Any) -> None:
    settings, sweeps = make_config("paper"), window(AV2Log(av2_folder), 0)
    result, (expected,) = loop.opencv_flow(sweeps, settings), CorrelationFlow(settings, "cpu")([sweeps])
    assert torch.equal(result.cluster_id, expected.cluster_id)
    same = (result.residual_flow - expected.residual_flow).abs().amax(1) <= 1e-5
    assert same[expected.is_valid].double().mean() >= 0.95
