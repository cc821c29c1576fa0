"""Objects that move farther than their size, by hand. The oracle covers random scenes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scenes import assert_same_bits, flow_as_oracle

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.verified import unlinked
from cflow_torch.verified.component_tree import NodeKind
from cflow_torch.verified.unlinked import link_unlinked

REGION = (-60.0, -20.0, -3.0, 60.0, 20.0, 3.0)
MODEL = VerifiedFlow.from_preset("default", point_cloud_range=REGION)
NUM_SWEEPS = 6  # t+1, t, t-1, ...


def window(shape: np.ndarray, step: float, seed: int = 0) -> Window:
    """A shape that moves `step` metres along x per sweep, in front of a wall at rest; the wall comes first."""
    rng = np.random.default_rng(seed)
    places = [shape - (k * step, 0.0, 0.0) for k in range(NUM_SWEEPS)]
    return with_wall([place + rng.normal(0, 0.01, shape.shape) for place in places], rng)


def plants(seed: int) -> Window:
    """Forty bushes at rest, of which every sweep sees other points."""
    rng = np.random.default_rng(seed)
    centre = rng.uniform((5, -15, 0), (45, 8, 0), (40, 1, 3))
    shapes = [centre + rng.uniform(-0.3, 0.3, (40, 8, 3)) for _ in range(NUM_SWEEPS)]
    return with_wall([shape.reshape(-1, 3) for shape in shapes], rng)


def with_wall(shapes: list[np.ndarray], rng: np.random.Generator) -> Window:
    """A window of shapes, the newest first."""
    wall = np.stack((rng.uniform(-50, 50, 3000), np.full(3000, 12.03), rng.uniform(-1, 1, 3000)), 1)
    clouds = [np.concatenate((wall, shape)).astype(np.float32) for shape in shapes]
    sweeps = [Sweep(torch.from_numpy(cloud), pose=np.eye(4)) for cloud in clouds]
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def num_linked(window: Window) -> int:
    """The number of nodes of fast objects."""
    trees = []

    class Observed(VerifiedFlow):
        @staticmethod
        def link_unlinked(*args):
            trees.append(link_unlinked(*args))
            return trees[-1]

    Observed(MODEL.config)([window])
    return int((trees[0].kind == NodeKind.UNLINKED).sum())


def front(seed: int, num_points: int) -> np.ndarray:
    """The front of a far car: few points, 0.5 m deep and 1.7 m wide."""
    low, high = (30.0, -0.8, -0.6), (30.5, 0.9, 0.4)
    return np.random.default_rng(seed).uniform(low, high, (num_points, 3))


@pytest.mark.parametrize("step", [-2.2, 2.2, 3.5])
@pytest.mark.parametrize("num_points", [14, 30, 400])  # with 400, the car hides where it will be
def test_a_far_car_of_few_points_is_found(step, num_points):
    (result,) = MODEL([window(front(1, num_points), step)])
    flow = result.residual_flow[3000:]
    assert torch.allclose(flow, torch.tensor([step, 0.0, 0.0]).expand_as(flow), atol=0.05)
    assert len(result.cluster_id[3000:].unique()) == 1 and not result.residual_flow[:3000].any()


def test_a_car_that_has_just_entered_the_region_is_found():
    """Only t-1 can confirm it. At t-2, it was outside of the region and its margin, which end at x = -64 m."""
    entering = front(1, 30) - (84.0, 0.0, 0.0)
    result = flow_as_oracle(window(entering, 3.5), MODEL.config)
    flow = result.residual_flow[3000:]
    assert torch.allclose(flow, torch.tensor([3.5, 0.0, 0.0]).expand_as(flow), atol=0.05)
    # Without t-1, nothing confirms it.
    sweeps = window(entering, 3.5)
    lone = replace(sweeps, pch=(Sweep(sweeps.pc1.points[:3000], pose=np.eye(4)), *sweeps.pch[1:]))
    assert not MODEL([lone])[0].residual_flow.any()


@pytest.mark.parametrize("step", [-2.2, 3.5])
def test_in_a_pair_an_unmatched_component_goes_with_the_nearest_one_of_like_size(step):
    shape = np.concatenate((front(1, 40), front(2, 40) + (14.0, 4.0, 0.0)))  # two cars
    pair = replace(window(shape, step), pch=())
    result = flow_as_oracle(pair, MODEL.config)
    flow = result.residual_flow[3000:]
    assert (flow - torch.tensor([step, 0.0, 0.0])).norm(dim=1).median() < 0.1
    assert not result.residual_flow[:3000].any()
    # Without the cars of t+1, there is nothing to go with.
    lone = replace(pair, pc1=Sweep(pair.pc1.points[:3000], pose=np.eye(4)))
    assert not MODEL([lone])[0].residual_flow.any()


def test_objects_that_their_pixels_link_are_not_linked_again():
    """The part is 1.7 m wide. Less than half of that from sweep to sweep leaves the pixels connected."""
    assert num_linked(window(front(1, 30), 0.7)) == 0
    assert num_linked(window(front(1, 30), 1.2)) == 1


def test_plants_are_not_linked_with_each_other():
    """Changing pixels of plants confirm many velocities by chance, but their pixels are also found in place."""
    assert sum(num_linked(plants(seed)) for seed in range(3)) <= 8  # 21 with every velocity


def test_a_pair_has_too_little_evidence():
    pair = window(front(1, 14), 2.2)
    assert not MODEL([Window(pair.pc0, pair.pc1)])[0].residual_flow.any()


def test_a_thin_line_that_moves_along_itself_stays():
    """Beams hit a guard rail at places that move with the sensor."""
    rail = np.stack((np.linspace(20, 20.8, 20), np.full(20, 5.93), np.linspace(-0.4, -0.3, 20)), 1)
    assert not MODEL([window(rail, 2.5)])[0].residual_flow.any()
    across = np.stack((np.full(20, 20.03), np.linspace(5, 5.8, 20), rail[:, 2]), 1)
    assert MODEL([window(across, 2.5)])[0].residual_flow[3000:].any(1).all()


def test_windows_of_a_batch_do_not_meet():
    windows = [window(front(seed, 20), step, seed) for seed, step in ((2, 2.0), (3, -3.0), (4, 0.0))]
    pair = Window(windows[0].pc0, windows[0].pc1)
    for result, one in zip(MODEL([*windows, pair]), [*windows, pair]):
        assert_same_bits(result, MODEL([one])[0])


def test_the_cost_of_a_velocity_does_not_depend_on_sweeps_that_other_windows_have():
    rng = torch.Generator().manual_seed(0)
    error, moved = torch.rand((2, 200, 6), generator=rng, dtype=torch.float64)

    def cost(num_steps: int) -> torch.Tensor:
        is_given = (torch.arange(num_steps) < 6)[None]
        sweeps: Any = SimpleNamespace(
            is_given=is_given, grid=SimpleNamespace(pixel_size=0.1), has_history=torch.tensor([True])
        )
        more = (0, num_steps - 6)
        window = torch.zeros(200, dtype=torch.int64)
        return unlinked._judge(sweeps, window, F.pad(error, more), F.pad(moved, more))[1]

    assert torch.equal(cost(9), cost(6)) and cost(6).isfinite().all()
