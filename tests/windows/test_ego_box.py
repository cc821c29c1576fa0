"""Returns of the vehicle itself: they move with the sensor, and `ego_box` leaves them out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle import reference_flow
from scenes import assert_same, config
from scenes import scene as scene_of_boxes

from cflow_torch import CFlowError, Config, Sweep, Window
from cflow_torch.config import make_config
from cflow_torch.estimate import make_model

BOX = (-1.5, -1.0, 2.5, 1.0)
METHODS = [
    {},
    {"num_history": 2, "pixel_sizes": (0.5, 0.25)},
    {"proof": True, "clearance": 0.3, "children": True, "num_history": 2},
    {"method": "keypoints", "patch_size": 9},
]


def drive(num_history: int) -> Window:
    """The vehicle drives 0.8 m a sweep past a wall; hood and mirrors are seen from the sensor."""
    rng, sweeps = np.random.default_rng(0), []
    wall = rng.uniform((-6, 3.0, -1.0), (6, 3.2, 1.0), (600, 3))
    for k in range(num_history + 2):
        pose = np.eye(4)
        pose[0, 3] = -0.8 * k
        own = rng.uniform((1.2, -0.8, -1.0), (2.4, 0.8, -0.8), (200, 3))
        sweeps.append(Sweep(np.concatenate((wall - pose[:3, 3], own)).astype(np.float32), pose=pose))
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


@pytest.mark.parametrize("settings", METHODS)
def test_own_returns_do_not_move(settings):
    window = drive(settings.get("num_history", 0))
    moved = []
    for box in (None, BOX):
        chosen = config(**settings, ego_box=box)
        (result,) = make_model(chosen, "cpu")([window])
        assert_same(result, reference_flow(window, chosen))
        assert result.is_valid[600:].any() == (box is None)
        assert not result.residual_flow[:600, 0].gt(0.1).any()  # the wall
        moved.append(result.residual_flow[600:, 0].mean().item())
    assert moved[0] > 0.6 and moved[1] == 0.0


@pytest.mark.parametrize("seed", range(4))
def test_equals_the_reference(seed):
    chosen = config(**METHODS[seed], ego_box=(-3.0, -2.0, 2.5, 3.0))
    window = scene_of_boxes(700 + seed, num_history=chosen.num_history, poses=seed % 2 > 0)
    (result,) = make_model(chosen, "cpu")([window])
    assert_same(result, reference_flow(window, chosen))
    plain = make_model(chosen.replace(ego_box=None), "cpu")([window])[0]
    assert result.is_valid.sum() < plain.is_valid.sum()


def test_as_if_the_points_were_not_there():
    window = drive(2)
    chosen = config(num_history=2, ego_box=BOX)
    bare = [Sweep(sweep.points[:600], pose=sweep.pose) for sweep in (window.pc0, window.pc1, *window.pch)]
    (result,) = make_model(chosen, "cpu")([window])
    (expected,) = make_model(chosen.replace(ego_box=None), "cpu")([Window(bare[0], bare[1], tuple(bare[2:]))])
    for name in ("residual_flow", "cluster_id", "score", "is_valid", "flow"):
        assert torch.equal(getattr(result, name)[:600], getattr(expected, name)), name


def test_the_box_is_that_of_the_sweep_and_holds_its_ends():
    # At t the post lies in the box of t, not in that of t+1, 5 m ahead; NaN lies nowhere.
    pose = np.eye(4)
    pose[0, 3] = 5.0
    points = np.array([[2.5, 1.0, 0], [np.nextafter(2.5, 3), 0, 0], [math.nan, 0, 0], [0, 0, 0], [7.5, 0, 0]])
    window = Window(Sweep(points, pose=np.eye(4)), Sweep(points, pose=pose))
    settings = config(ego_box=BOX, point_cloud_range=(-10, -10, -5, 10, 10, 5))
    (result,) = make_model(settings, "cpu")([window])
    assert result.is_valid.tolist() == [False, True, False, False, True]


@pytest.mark.parametrize(
    "wrong", [(1, 2, 3), (1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 1.0, 1.0), (-math.inf, -1, 1, 1), (math.nan, -1, 1, 1), 3]
)
def test_boxes_that_make_no_sense(wrong):
    with pytest.raises(CFlowError, match="ego_box"):
        Config(ego_box=wrong)


def test_no_paper_preset_has_one():
    assert make_config("paper").ego_box is None
    assert make_config("paper", ego_box=[-1, -1, 1, 1]).ego_box == (-1.0, -1.0, 1.0, 1.0)
