"""Ground without a map: exact properties, accuracy on simulated and real sweeps, `ground="auto"` and the warning."""

from __future__ import annotations

import sys
import warnings
from typing import List, Tuple

import numpy as np
import pytest
import torch
from scenes import assert_same, needs_gpu

from cflow_torch import CFlowError, Sweep, Window, estimate_flow, make_config, make_model
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.simulator import make_drive
from cflow_torch.windows.ground import find_ground, find_ground_batch, has_ground

SEEDS = (410, 411, 412)  # the method was tuned on 400 ... 409


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / (a | b).sum())


def rings(height: float, beams: int = 16, columns: int = 900) -> np.ndarray:
    """(N, 3) where the beams of a level LiDAR meet a level floor `height` metres below it."""
    down = np.radians(np.linspace(-25.0, -1.0, beams))
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)
    r = np.repeat(height / np.tan(-down), columns)
    angle = np.tile(azimuth, beams)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(r, -height)], 1)
    return points[r < 100]


def block(low: Tuple[float, float, float], high: Tuple[float, float, float], num_points: int, seed: int) -> np.ndarray:
    """(N, 3) points in a box."""
    return np.random.default_rng(seed).uniform(low, high, (num_points, 3))


@pytest.fixture(scope="module")
def sweeps() -> List[Sweep]:
    drive = make_drive(seed=410, num_sweeps=3, profile="demo")
    return [drive.sweep(i) for i in range(3)]


# ---- exact properties


def test_the_order_of_points_does_not_matter(sweeps):
    points = sweeps[0].points
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(find_ground(points)[order], find_ground(points[order]))


def test_a_batch_equals_its_sweeps_one_by_one(sweeps):
    clouds = [s.points for s in sweeps] + [np.zeros((0, 3)), block((4, 4, 0), (8, 6, 1.5), 900, 0)]
    for mask, cloud in zip(find_ground_batch(clouds), clouds):
        assert np.array_equal(mask, find_ground(cloud))
    assert find_ground_batch([]) == []


@pytest.mark.parametrize("shift", [-2.5, -1.723, -0.001, 0.35, 812.345])
def test_the_mounting_height_does_not_matter(sweeps, shift):
    points = np.round(sweeps[0].points.astype(np.float64) * 1000)
    shifted = points + [0, 0, round(shift * 1000)]
    assert np.array_equal(find_ground(points / 1000), find_ground(shifted / 1000))


def test_a_quarter_turn_changes_little(sweeps):
    points = sweeps[0].points
    turned = np.stack([-points[:, 1], points[:, 0], points[:, 2]], 1)
    assert overlap(find_ground(points), find_ground(turned)) > 0.99


def test_points_that_are_not_finite_or_far_away_are_not_ground(sweeps):
    points = sweeps[0].points + np.array([0, 0, 0.5], np.float32)  # the origin lies below the ground
    bad = np.full((8, 3), -0.5, np.float32)
    bad[:5, 0] = (np.nan, np.inf, -np.inf, 131.08, 1e30)
    bad[5:, 2] = (np.nan, np.inf, -np.inf)
    mask = find_ground(np.concatenate([points, bad]))
    assert not mask[-8:].any()
    assert np.array_equal(mask[:-8], find_ground(points))
    assert find_ground(np.concatenate([points, np.full((1, 3), -0.5, np.float32)]))[-1]


@pytest.mark.parametrize("number", [0, 1, 2, 30])
def test_few_points_have_no_ground(number):
    mask = find_ground(np.random.default_rng(0).normal(0, 5, (number, 4)))
    assert mask.dtype == np.bool_ and mask.shape == (number,) and not mask.any()


def test_arrays_give_arrays_and_tensors_tensors(sweeps):
    points = sweeps[0].points
    mask = find_ground(torch.from_numpy(points))
    assert isinstance(mask, torch.Tensor) and mask.dtype == torch.bool
    assert np.array_equal(mask.numpy(), find_ground(points))
    copy = points.copy()
    find_ground(copy)
    assert np.array_equal(copy, points)


@needs_gpu
def test_a_gpu_gives_the_same_bits(sweeps):
    clouds = [s.points for s in sweeps]
    for a, b in zip(find_ground_batch(clouds, device="cuda"), find_ground_batch(clouds, device="cpu")):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"points": [1, 2, 3]}, "list"),
        ({"points": np.zeros((4, 2))}, r"\(4, 2\)"),
        ({"points": np.zeros((4, 3), int)}, "int"),
        ({"points": np.zeros((4, 3)), "method": "ransac"}, "'ransac'.*'grid'.*'patchwork'"),
        ({"points": np.zeros((4, 3)), "threshold": -0.1}, "threshold=-0.1"),
        ({"points": np.zeros((4, 3)), "threshold": True}, "threshold=True"),
    ],
)
def test_bad_arguments(arguments, complaint):
    with pytest.raises(CFlowError, match=complaint):
        find_ground(**arguments)


# ---- scenes made by hand


def test_a_level_floor_seen_by_sixteen_beams_and_what_stands_on_it():
    for height in (0.5, 1.0, 1.73, 3.0):
        floor = rings(height)
        box = block((6, -1, 0.31 - height), (10, 1, 1.5 - height), 2000, 1)
        mask = find_ground(np.concatenate([floor, box]))
        assert mask[: len(floor)].all(), height
        assert not mask[len(floor) :].any(), height


def test_a_tilted_floor():
    for slope in (-0.22, 0.22):
        floor = rings(1.7)
        floor[:, 2] += slope * (0.8 * floor[:, 0] + 0.6 * floor[:, 1])
        box = block((6, -1, 0.45), (10, 1, 1.5), 2000, 1)
        box[:, 2] += -1.7 + slope * (0.8 * box[:, 0] + 0.6 * box[:, 1])
        mask = find_ground(np.concatenate([floor, box]))
        assert mask[: len(floor)].mean() > 0.99 and not mask[len(floor) :].any()


def test_kerbs_are_ground_and_walls_are_not():
    floor = rings(1.7)
    floor[:, 2] += 0.15 * (floor[:, 1] > 4)
    wall = block((-20, 9, -1.2), (20, 9.1, 3), 5000, 2)
    mask = find_ground(np.concatenate([floor, wall]))
    assert mask[: len(floor)].mean() > 0.995 and not mask[len(floor) :].any()


def test_bridges_and_roofs_are_not_ground():
    floor = rings(1.7)
    bridge = block((12, -15, 3.2), (20, 15, 3.3), 6000, 3)
    floor = floor[(floor[:, 0] < 12) | (floor[:, 0] > 20)]  # hides the road under it
    roof = block((-40, 20, 2.5), (-20, 40, 2.6), 4000, 4)
    mask = find_ground(np.concatenate([floor, bridge, roof]))
    assert mask[: len(floor)].all() and not mask[len(floor) :].any()


def test_multipath_points_below_the_ground_do_not_pull_it_down(sweeps):
    points, exact = sweeps[0].points.copy(), find_ground(sweeps[0].points)
    rng = np.random.default_rng(5)
    for share in (0.001, 0.01):
        rows = rng.choice(len(points), int(share * len(points)), replace=False)
        rain = points.copy()
        rain[rows, 2] -= rng.uniform(0.5, 4, len(rows)).astype(np.float32) + np.maximum(rain[rows, 2], 0)
        keep = np.ones(len(points), bool)
        keep[rows] = False
        assert overlap(find_ground(rain)[keep], exact[keep]) > 0.98, share


# ---- accuracy


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("profile", "floor"), [("av2", 0.93), ("demo", 0.97)])
def test_simulated_drives(seed, profile, floor):
    drive = make_drive(seed=seed, num_sweeps=1, profile=profile)
    sweep = drive.sweep(0)
    world = sweep.points.astype(np.float64) @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
    above = world[:, 2] - drive.scene.ground.height(world[:, 0], world[:, 1])
    mask = find_ground(sweep.points)
    assert overlap(mask, above <= 0.3) > floor  # the rule of the raster
    assert mask[sweep.is_ground].mean() > 0.99  # what rays truly hit the ground


def test_a_simulated_drive_bent_into_hills():
    drive = make_drive(seed=410, num_sweeps=1, profile="av2")
    sweep = drive.sweep(0)
    points = sweep.points.astype(np.float64)
    world = points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
    truth = world[:, 2] - drive.scene.ground.height(world[:, 0], world[:, 1]) <= 0.3
    points[:, 2] += 1.5 * np.sin(2 * np.pi * points[:, 0] / 80) + 0.1 * points[:, 1]  # 12 % up and down on 10 %
    assert overlap(find_ground(points), truth) > 0.9


def test_the_real_pair_against_the_map(av2_folder):
    log = AV2Log(av2_folder)
    for index in (0, 1):
        sweep = log.sweep(index)
        assert overlap(find_ground(sweep.points), sweep.is_ground) > 0.93  # also where the map knows nothing
        sensor = sweep.points - np.array([1.35, 0, 1.64], np.float32)
        assert overlap(find_ground(sensor), sweep.is_ground) > 0.93


def test_kitti_against_its_stored_mask(kitti_file):
    pytest.importorskip("h5py")
    with HDF5Log(kitti_file) as log:
        sweep = log.sweep(7)
        assert overlap(find_ground(sweep.points), sweep.is_ground) > 0.93


def test_patchwork_is_optional(monkeypatch, sweeps):
    monkeypatch.setitem(sys.modules, "pypatchworkpp", None)
    with pytest.raises(CFlowError, match="pip install pypatchworkpp"):
        find_ground(sweeps[0].points, method="patchwork")


def test_patchwork():
    pytest.importorskip("pypatchworkpp")
    drive = make_drive(seed=410, num_sweeps=1, profile="av2")
    sweep = drive.sweep(0)
    for shift in (0.0, 1.7):
        mask = find_ground(sweep.points + np.array([0, 0, shift], np.float32), method="patchwork")
        assert overlap(mask, sweep.is_ground) > 0.8
    assert not find_ground(np.zeros((0, 3)), method="patchwork").any()


# ---- estimate_flow


@pytest.fixture(scope="module")
def scene() -> Tuple[Window, np.ndarray, np.ndarray]:
    """Two bare clouds with ground, a car that moves 0.8 m, walls and parked cars; which rows of pc0 are which."""
    floor = rings(1.7, beams=32)
    car = block((8, -1, -1.5), (12, 0.8, 0.0), 3000, 6)
    still = np.concatenate(
        [block((x, y, -1.65), (x + 4, y + 1.8, 0.0), 2000, 7) for x, y in ((-9, 4), (5, 5), (16, 4))]
    )
    clouds = []
    for step in (0, 1):
        moved = car + [0.8 * step, 0, 0]
        clouds.append(np.concatenate([moved, still, floor]))
    part = np.repeat([0, 1, 2], [len(car), len(still), len(floor)])
    return Window(Sweep(clouds[0]), Sweep(clouds[1])), part == 0, part == 1


def test_auto_finds_the_moving_car_and_leaves_the_rest_still(scene):
    window, car, still = scene
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result = estimate_flow(window.pc0.points, window.pc1.points, ground="auto", preset="paper")
    flow = result.residual_flow.numpy()
    # The lowest 0.3 m of everything count as ground, and between rings the surface is up to 0.15 m too high.
    above = window.pc0.points[:, 2] > -1.25
    assert np.allclose(flow[car & above], [0.8, 0, 0], atol=1e-6)
    assert not flow[~car].any()
    assert result.is_valid.numpy()[(car | still) & above].all()
    assert not result.is_valid.numpy()[~car & ~still].any()


def test_without_masks_a_warning_and_the_same_result(scene):
    window, car, _ = scene
    with pytest.warns(UserWarning, match="ground='auto'") as record:
        result = estimate_flow(window.pc0.points, window.pc1.points, preset="paper")
    assert len(record) == 1 and record[0].filename == __file__
    (direct,) = make_model(make_config("paper"))([window])
    assert_same(result, direct)
    assert np.abs(result.residual_flow.numpy()[car] - [0.8, 0, 0]).max() > 0.5  # what the warning is about


def test_auto_keeps_the_masks_that_are_given(scene):
    window, car, still = scene
    mine = car  # not ground at all, but it is the user's word
    result = estimate_flow(window.pc0.points, window.pc1.points, gm0=mine, ground="auto", preset="paper")
    assert np.array_equal(result.is_valid.numpy()[car], np.zeros(car.sum(), bool))
    assert result.is_valid.numpy()[still].all()


def test_auto_masks_the_history_too(scene):
    window, car, _ = scene
    older = window.pc0.points - np.where(car[:, None], [0.8, 0, 0], 0)
    clouds = (window.pc0.points, window.pc1.points)
    auto = estimate_flow(*clouds, pch=[older], num_history=1, preset="paper", ground="auto")
    gm0, gm1, gmh = find_ground_batch([*clouds, older])
    masked = estimate_flow(*clouds, pch=[older], num_history=1, preset="paper", gm0=gm0, gm1=gm1, gmh=[gmh])
    assert_same(auto, masked)


def warned(*clouds: np.ndarray, **settings) -> bool:
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        estimate_flow(*clouds, preset="paper", **settings)
    return any(issubclass(w.category, UserWarning) and "ground" in str(w.message) for w in record)


def test_the_warning_fires_only_where_there_is_ground_and_no_mask(scene, sweeps):
    pc0, pc1 = sweeps[0], sweeps[1]
    assert warned(pc0.points, pc1.points)
    assert warned(pc0.points, pc1.points, gm0=pc0.is_ground)  # pc1 still holds its ground
    assert not warned(pc0.points, pc1.points, gm0=pc0.is_ground, gm1=pc1.is_ground)
    assert not warned(pc0.points[~pc0.is_ground], pc1.points[~pc1.is_ground])
    assert not warned(pc0.points[~find_ground(pc0.points)], pc1.points[~find_ground(pc1.points)])
    car = scene[0].pc0.points[scene[1]]
    assert not warned(car, car)
    assert not warned(np.zeros((0, 3)), np.zeros((0, 3)))


@pytest.mark.parametrize("seed", SEEDS)
def test_clouds_whose_ground_was_removed_have_none(seed):
    sweep = make_drive(seed=seed, num_sweeps=1, profile="av2").sweep(0)
    rest = [sweep.points[~sweep.is_ground], sweep.points[~find_ground(sweep.points)], sweep.points]
    assert has_ground(rest) == [False, False, True]


def test_real_clouds_whose_ground_was_removed_have_none(av2_folder):
    log = AV2Log(av2_folder)
    for index in (0, 1):
        sweep = log.sweep(index)
        mine = find_ground(sweep.points)
        assert has_ground([sweep.points, sweep.points[~sweep.is_ground], sweep.points[~mine]]) == [True, False, False]
