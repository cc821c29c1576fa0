"""The proof as a whole: the same bits however windows come, what each part is for, settings that make no sense."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle import reference_flow
from scenes import LABELINGS, config, needs_gpu
from scenes import assert_same as assert_equal
from scenes import scene as scene_of_boxes

from cflow_torch import CFlowError, Config, CorrelationFlow, Sweep, Window
from cflow_torch.config import make_config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch

EVERY = slice(None)
ALL = {
    "proof": True,
    "pixel_sizes": (0.4, 0.2, 0.1),
    "point_cloud_range": (-8.0, -8.0, -3.0, 8.0, 8.0, 5.0),
    "max_object": 10.0,
    "max_speed": 40.0,
    "clearance": 0.4,
    "children": True,
    "aperture": True,
    "relocate": True,
    "nudge": True,
    "yaw": True,
    "slow": True,
}


def box(centre, size, angle, rng, num_points=250):
    """Points on the sides of an upright box, standing 0.2 m above z = -1.7."""
    side = rng.integers(0, 4, num_points)
    along = rng.uniform(-0.5, 0.5, num_points)
    x = np.where(side < 2, along, np.where(side == 2, -0.5, 0.5)) * size[0]
    y = np.where(side >= 2, along, np.where(side == 0, -0.5, 0.5)) * size[1]
    cos, sin = np.cos(angle), np.sin(angle)
    xy = np.stack((cos * x - sin * y, sin * x + cos * y), 1) + centre
    return np.concatenate((xy, rng.uniform(-1.5, 0.0, (num_points, 1))), 1)


def scene(seed: int, num_history: int = 0) -> Window:
    """A car that turns, a person beside a wall, a post, ground; every sweep sampled anew; ego stands still."""
    rng = np.random.default_rng(seed)
    start, velocity, turn = rng.uniform(-2, 2, 2), rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.05, 0.05)
    sweeps = []
    for k in range(1, -num_history - 1, -1):  # t+1 first
        parts = [
            box(start + k * velocity, (4.0, 1.8), 0.3 + k * turn, rng),
            box((-5.0 + 0.12 * k, -5.4), (0.4, 0.5), 0.0, rng, 60),
            box((-4.0, -6.2), (6.0, 0.3), 0.0, rng),
            box((5.5, 5.5), (0.3, 0.3), 0.0, rng, 40),
            np.concatenate((rng.uniform(-8, 8, (1500, 2)), rng.normal(-1.75, 0.02, (1500, 1))), 1),
            np.concatenate((rng.uniform(-8, 8, (40, 2)), rng.uniform(-1.7, -1.45, (40, 1))), 1),  # left over
        ]
        is_ground = np.zeros(sum(map(len, parts)), dtype=bool)
        is_ground[-1540:-40] = True
        order = rng.permutation(len(is_ground))
        sweeps.append(Sweep(np.concatenate(parts)[order].astype(np.float32), is_ground=is_ground[order]))
    return Window(pc0=sweeps[1], pc1=sweeps[0], pch=tuple(sweeps[2:]))


def model(**overrides) -> CorrelationFlow:
    return CorrelationFlow(Config(**{**ALL, **overrides}))


def assert_same(one, other, rows=EVERY):
    for name in ("residual_flow", "cluster_id", "score", "is_valid", "flow"):
        assert torch.equal(getattr(one, name)[rows], getattr(other, name)), name


@pytest.mark.parametrize("height_slices", [0, 4])
def test_alone_or_in_a_batch(height_slices):
    # Mixed lengths of history: only the windows that are pairs are relocated, whatever lies beside them.
    windows = [scene(0, 2), scene(1), scene(2, 1), scene(3, 2)]
    flow = model(num_history=2, height_slices=height_slices)
    for window, result in zip(windows, flow(windows)):
        assert_same(flow([window])[0], result)


def small(window: Window, rng) -> Window:
    """A fifth of the points: the reference is slow."""

    def thin(sweep):
        keep = rng.random(len(sweep.points)) < 0.3
        return Sweep(sweep.points[keep], is_ground=sweep.is_ground[keep])

    return Window(thin(window.pc0), thin(window.pc1), tuple(thin(sweep) for sweep in window.pch))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("num_history", [0, 2])
def test_equals_the_reference(seed, num_history):
    config = model(num_history=num_history, height_slices=seed % 2 * 4).config
    window = small(scene(seed, num_history), np.random.default_rng(seed))
    result, expected = CorrelationFlow(config)([window])[0], reference_flow(window, config)
    assert result.residual_flow.any()
    assert torch.equal(result.cluster_id, expected.cluster_id)
    for name in ("residual_flow", "score", "is_valid", "flow"):
        assert torch.equal(getattr(result, name), getattr(expected, name)), name


@pytest.mark.parametrize("labeling", LABELINGS)
def test_equals_the_reference_on_many_scenes(labeling):
    moved = 0
    for seed in range(24):
        settings = config(
            num_history=seed % 4,
            pixel_sizes=((0.25,), (0.5, 0.25), (0.75, 0.25))[seed % 3],
            height_slices=seed % 2 * 4,
            labeling=labeling,
            max_speed=(None, 6.0)[seed % 5 == 0],
            use_timestamps=seed % 4 > 1,
            max_object=(None, 4.0)[seed % 3 > 0],
            proof=True,
            proof_z=(0.0, 1.0, 2.0)[seed % 3],
            clearance=(None, 0.3)[seed % 7 > 0],
            **{
                name: (seed + i) % 5 > 0
                for i, name in enumerate(("children", "aperture", "relocate", "nudge", "yaw", "slow"))
            },
        )
        window = scene_of_boxes(300 + seed, num_history=seed % 4, poses=seed % 5 > 0, stamps=seed % 2 > 0)
        (result,) = CorrelationFlow(settings)([window])
        assert_equal(result, reference_flow(window, settings))
        moved += int(result.residual_flow.any())
    assert moved > 12


def test_equals_the_reference_on_the_real_pair(av2_folder):
    window = window_of(AV2Log(av2_folder), 0)
    region = (
        -20.0,
        -10.0,
        -math.inf,
        0.0,
        5.0,
        math.inf,
    )  # the whole takes the reference two minutes; it is equal, too
    settings = make_config("paper", **{**ALL, "point_cloud_range": region, "max_object": 6.0})
    (result,) = CorrelationFlow(settings)([window])
    assert (result.residual_flow.norm(dim=1) >= 0.05).sum() > 500  # there is something to find
    assert_equal(result, reference_flow(window, settings))


def shuffled(sweep: Sweep, rng):
    order = rng.permutation(len(sweep.points))
    return Sweep(sweep.points[order], is_ground=sweep.is_ground[order]), order


@pytest.mark.parametrize("num_history", [0, 2])
def test_the_order_of_points_does_not_matter(num_history):
    flow, window, rng = model(num_history=num_history), scene(4, num_history), np.random.default_rng(0)
    pc0, order = shuffled(window.pc0, rng)
    others = tuple(shuffled(sweep, rng)[0] for sweep in window.pch)
    assert_same(flow([window])[0], flow([Window(pc0, shuffled(window.pc1, rng)[0], others)])[0], order)


def test_threads_do_not_matter():
    windows, flow, threads = [scene(5, 2)], model(num_history=2), torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = flow(windows)[0]
        torch.set_num_threads(2)
        assert_same(one, flow(windows)[0])
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("labeling", LABELINGS)
@pytest.mark.parametrize("height_slices", [0, 4])
def test_engines_do_not_matter(height_slices, labeling):
    window = scene(6)
    expected = model(height_slices=height_slices)([window])[0]
    assert_same(expected, model(height_slices=height_slices, labeling=labeling, correlation="conv")([window])[0])


@pytest.mark.cuda
@needs_gpu
def test_cuda_equals_cpu():
    windows = [scene(0, 2), scene(1), scene(2, 1), scene(3, 2)]
    for height_slices in (0, 4):
        settings = model(num_history=2, height_slices=height_slices).config
        on_cpu = CorrelationFlow(settings, device="cpu")(windows)
        for cpu, gpu in zip(on_cpu, CorrelationFlow(settings, device="cuda")(windows)):
            assert_equal(cpu, gpu)


def test_a_turning_car_moves_and_the_rest_stands_still():
    window = scene(7, 2)
    result = model(num_history=2)([window])[0]
    rng = np.random.default_rng(7)
    start, velocity, turn = rng.uniform(-2, 2, 2), rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.05, 0.05)
    points = window.pc0.points[:, :2].astype(np.float64)
    arm = points - start
    truth = velocity + turn * np.stack((-arm[:, 1], arm[:, 0]), 1)
    is_car = (np.abs(arm) < 2.4).all(1) & (window.pc0.points[:, 2] > -1.4) & ~window.pc0.is_ground
    error = np.linalg.norm(result.residual_flow.numpy()[is_car, :2] - truth[is_car], axis=1)
    is_static = ~is_car & (points[:, 1] > -5.0)  # neither the person nor the wall beside
    assert error.mean() < 0.03
    assert result.residual_flow[is_static].any(1).sum() < 0.02 * is_static.sum()


def test_empty_and_hopeless_windows():
    empty = Sweep(np.zeros((0, 3), np.float32))
    lost = Sweep(np.full((5, 3), np.nan, np.float32))
    one = Sweep(np.zeros((1, 3), np.float32))
    for pc0, pc1 in ((empty, empty), (lost, one), (one, lost), (one, one)):
        (result,) = model()([Window(pc0, pc1)])
        assert result.residual_flow.shape == (len(pc0.points), 3)
        assert not result.residual_flow.any()


@pytest.mark.parametrize("name", ["default", "fast"])
def test_presets_follow_the_reference(name):
    flow = CorrelationFlow.from_preset(name, point_cloud_range=ALL["point_cloud_range"])
    window = scene(5, flow.config.num_history)
    assert flow.config.proof
    (result,) = flow([window])
    assert_equal(result, reference_flow(window, flow.config))
    assert result.residual_flow.any()


@pytest.mark.parametrize(
    "wrong",
    [
        {"proof": 1},
        {"proof_z": -1.0},
        {"proof_z": True},
        {"clearance": 0.0},
        {"pixel_sizes": (0.25, 0.1)},
        {"proof_z": 1001},
        {"children": 1},
        {"pixel_sizes": (0.25, 0.1)},
    ],
)
def test_settings_that_make_no_sense(wrong):
    with pytest.raises(CFlowError, match=next(iter(wrong))):
        Config(**{**ALL, **wrong})


def test_parts_of_the_proof_mean_nothing_without_it():
    # So that `proof=False` is all that there is to say.
    parts = {"proof_z": 5.0, "clearance": None, "children": False, "aperture": False, "relocate": False, "yaw": False}
    with_parts, without = model(proof=False), model(proof=False, **parts)
    assert all(getattr(with_parts.config, name) != value for name, value in parts.items())
    (one,), (other,) = with_parts([scene(0)]), without([scene(0)])
    assert one.residual_flow.any()
    assert_same(one, other)
    grid = Grid(0.1, ALL["point_cloud_range"][:3], ALL["point_cloud_range"][3:])
    assert make_batch([scene(0)], with_parts.config, grid).ground is None


def test_a_wall_that_seems_to_slide_stands_still():
    # Its samples stand still in the frame of a sensor that drives 1.4 m.
    rng = np.random.default_rng(0)
    wall = np.stack((rng.uniform(-4, 4, 60), np.full(60, 3.05), rng.uniform(-1, 1, 60)), 1)
    window = Window(Sweep(wall - (1.4, 0.0, 0.0)), Sweep(wall))
    for aperture in (False, True):
        flow = model(aperture=aperture)
        (result,) = flow([window])
        assert_equal(result, reference_flow(window, flow.config))
        assert bool((result.residual_flow[:, 0] > 1.0).any()) != aperture


def test_what_relocation_puts_to_rest_is_not_refined(monkeypatch):
    assert model()([scene(1)])[0].residual_flow.any()
    monkeypatch.setattr(
        "cflow_torch.verified.method.relocate", lambda points, grid, count, motion: torch.zeros_like(motion)
    )
    assert not model()([scene(1)])[0].residual_flow.any()


def test_speed_is_bounded_at_every_pixel_size():
    # Half of the box allows 2 m, the speed 0.6 m and a pixel.
    car = box((0.0, 0.0), (4.0, 1.8), 0.0, np.random.default_rng(0))
    window = Window(Sweep(car - (1.7, 0.0, 0.0)), Sweep(car))
    moved = []
    for max_speed in (None, 6.0):
        flow = model(max_speed=max_speed, relocate=False, yaw=False)
        (result,) = flow([window])
        assert_equal(result, reference_flow(window, flow.config))
        moved.append(result.residual_flow[:, 0].max())
    assert moved[0] > 1.6 and moved[1] <= 0.6 + 0.4 + 0.2


def test_ground_counts_of_the_newest_pair_only():
    window, grid = scene(8, 2), Grid(0.1, ALL["point_cloud_range"][:3], ALL["point_cloud_range"][3:])
    batch = make_batch([scene(9), window], model(num_history=2).config, grid)
    for index, one in enumerate(batch.ground[1].sum((1, 2)).tolist()):
        pair = (scene(9), window)[index]
        assert one == pair.pc0.is_ground.sum() + pair.pc1.is_ground.sum()
    assert make_batch([window], model(num_history=2, clearance=None).config, grid).ground is None
