"""Ground without a map: exact properties, hand-made scenes, accuracy on simulated and real sweeps, `ground="auto"`."""

from __future__ import annotations

from typing import Tuple

import numpy as np
import pytest
import torch
from scenes import assert_same, needs_gpu

from cflow_torch import CFlowError, Sweep, estimate_flow
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.ground.segmentation import find_ground, find_ground_batch, has_ground
from cflow_torch.simulator import make_drive

SEED = 410  # the method was tuned on 400 ... 409
Point = Tuple[float, float, float]


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union."""
    return float((a & b).sum() / (a | b).sum())


def rings(height: float, beams: int = 16, columns: int = 900) -> np.ndarray:
    """(N, 3) returns of a level LiDAR from a level floor `height` metres below it."""
    down = np.radians(np.linspace(-25.0, -1.0, beams))
    r = np.repeat(height / np.tan(-down), columns)
    angle = np.tile(np.linspace(-np.pi, np.pi, columns, endpoint=False), beams)
    points = np.stack([r * np.cos(angle), r * np.sin(angle), np.full_like(r, -height)], 1)
    return points[r < 100]


def block(low: Point, high: Point, num_points: int, seed: int) -> np.ndarray:
    """(N, 3) points in a box."""
    return np.random.default_rng(seed).uniform(low, high, (num_points, 3))


@pytest.fixture(scope="module")
def sweeps() -> list[Sweep]:
    drive = make_drive(seed=SEED, num_sweeps=2, profile="demo")
    return [drive.sweep(i) for i in range(2)]


def test_order_of_points_and_other_sweeps_do_not_matter(sweeps):
    points = sweeps[0].points
    order = np.random.default_rng(1).permutation(len(points))
    assert np.array_equal(find_ground(points)[order], find_ground(points[order]))
    few = [np.zeros((0, 3)), np.ones((1, 4)), block((4, 4, 0), (8, 6, 1.5), 900, 0)]
    masks = find_ground_batch([*(sweep.points for sweep in sweeps), *few])
    assert all(np.array_equal(mask, find_ground(sweep.points)) for mask, sweep in zip(masks, sweeps))
    for mask, cloud in zip(masks[2:], few):
        assert mask.dtype == np.bool_ and mask.shape == (len(cloud),) and not mask.any()
    assert find_ground_batch([]) == []


def test_the_mounting_height_does_not_matter(sweeps):
    points = np.round(sweeps[0].points.astype(np.float64) * 1000)
    assert np.array_equal(find_ground(points / 1000), find_ground((points + [0, 0, -1723]) / 1000))


def test_points_that_are_not_finite_or_far_away_are_not_ground(sweeps):
    points = sweeps[0].points + np.array([0, 0, 0.5], np.float32)  # the origin is below the ground
    bad = np.full((8, 3), -0.5, np.float32)
    bad[:5, 0] = (np.nan, np.inf, -np.inf, 131.08, 1e30)
    bad[5:, 2] = (np.nan, np.inf, -np.inf)
    mask = find_ground(np.concatenate([points, bad]))
    assert not mask[-8:].any() and np.array_equal(mask[:-8], find_ground(points))
    assert find_ground(np.concatenate([points, np.full((1, 3), -0.5, np.float32)]))[-1]
    assert not find_ground(points[:5000] + np.float32([1e4, 0, 0])).any()


def test_arrays_give_arrays_and_tensors_tensors(sweeps):
    points = sweeps[0].points.copy()
    mask = find_ground(torch.from_numpy(points))
    assert isinstance(mask, torch.Tensor) and np.array_equal(mask.numpy(), find_ground(points))
    assert np.array_equal(points, sweeps[0].points)


@pytest.mark.cuda
@needs_gpu
def test_a_gpu_finds_the_same(sweeps):
    clouds = [s.points for s in sweeps]
    for a, b in zip(find_ground_batch(clouds, device="cuda"), find_ground_batch(clouds, device="cpu")):
        assert np.array_equal(a, b)


def test_a_threshold_may_be_any_number():
    points = rings(1.7)
    assert np.array_equal(find_ground(points, threshold=np.float32(0.25)), find_ground(points, threshold=0.25))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"points": [1, 2, 3]}, "list"),
        ({"points": np.zeros((4, 2))}, r"\(4, 2\)"),
        ({"points": np.zeros((4, 3), int)}, "int"),
        ({"points": np.zeros((4, 3)), "method": "ransac"}, "'ransac'.*'grid'.*'patchwork'"),
        ({"points": np.zeros((4, 3)), "threshold": -0.1}, "threshold=-0.1"),
    ],
)
def test_bad_arguments(arguments, complaint):
    with pytest.raises(CFlowError, match=complaint):
        find_ground(**arguments)


@pytest.mark.parametrize("slope, height", [(0.0, 0.5), (0.0, 3.0), (-0.22, 1.7), (0.22, 1.7)])
def test_a_floor_is_ground_and_a_box_on_it_is_not(slope, height):
    low = 0.45 if slope else 0.31
    floor, box = rings(height), block((6, -1, low - height), (10, 1, 1.5 - height), 2000, 1)
    for points in (floor, box):
        points[:, 2] += slope * (0.8 * points[:, 0] + 0.6 * points[:, 1])
    mask = find_ground(np.concatenate([floor, box]))
    assert mask[: len(floor)].mean() >= (0.99 if slope else 1.0) and not mask[len(floor) :].any()


def test_kerbs_are_ground_and_walls_bridges_and_roofs_are_not():
    floor, wall = rings(1.7), block((-20, 9, -1.2), (20, 9.1, 3), 5000, 2)
    kerbs = floor + 0.15 * (floor[:, 1:2] > 4) * [0, 0, 1]
    bridge, roof = block((12, -15, 3.2), (20, 15, 3.3), 6000, 3), block((-40, 20, 2.5), (-20, 40, 2.6), 4000, 4)
    open_road = floor[(floor[:, 0] < 12) | (floor[:, 0] > 20)]  # the road under the bridge is occluded
    for ground, others in ((kerbs, wall), (open_road, np.concatenate([bridge, roof]))):
        mask = find_ground(np.concatenate([ground, others]))
        assert mask[: len(ground)].mean() > 0.995 and not mask[len(ground) :].any()


def test_multipath_points_below_the_ground_do_not_pull_it_down(sweeps):
    rain, rng = sweeps[0].points.copy(), np.random.default_rng(5)
    rows = rng.choice(len(rain), len(rain) // 100, replace=False)
    rain[rows, 2] -= rng.uniform(0.5, 4, len(rows)).astype(np.float32) + np.maximum(rain[rows, 2], 0)
    keep = np.ones(len(rain), bool)
    keep[rows] = False
    assert overlap(find_ground(rain)[keep], find_ground(sweeps[0].points)[keep]) > 0.98


def test_the_mirror_image_of_an_object_far_below_does_not_pull_the_ground_down(sweeps):
    points = sweeps[0].points
    for x, y, depth in ((-40, 1, 14), (30, 25, 30)):
        mirrored = block((x, y, -depth), (x + 0.5, y + 3, 0.5 - depth), 20, 6)
        mask = find_ground(np.concatenate([points, mirrored]))
        assert np.array_equal(mask[: len(points)], find_ground(points)), (x, y, depth)


def test_a_simulated_drive_on_flat_ground_and_on_hills():
    drive = make_drive(seed=SEED, num_sweeps=1, profile="av2")
    sweep = drive.sweep(0)
    points = sweep.points.astype(np.float64)
    world = points @ sweep.pose[:3, :3].T + sweep.pose[:3, 3]
    truth = world[:, 2] - drive.scene.ground.height(world[:, 0], world[:, 1]) <= 0.3  # the rule of the raster
    mask = find_ground(sweep.points)
    assert overlap(mask, truth) > 0.93 and mask[sweep.is_ground].mean() > 0.99  # rays that hit the ground
    points[:, 2] += 1.5 * np.sin(2 * np.pi * points[:, 0] / 80) + 0.1 * points[:, 1]  # 12 % up and down on 10 %
    assert overlap(find_ground(points), truth) > 0.9
    clouds = [sweep.points[~sweep.is_ground], sweep.points[~mask], sweep.points]
    assert [has_ground(cloud) for cloud in clouds] == [False, False, True]


def test_real_sweeps_agree_with_the_map_and_the_stored_mask(av2_folder, kitti_file):
    sweep = AV2Log(av2_folder).sweep(0)
    mine = find_ground(sweep.points)
    assert overlap(mine, sweep.is_ground) > 0.93  # also outside the map
    sensor = sweep.points - np.array([1.35, 0, 1.64], np.float32)
    assert overlap(find_ground(sensor), sweep.is_ground) > 0.93
    clouds = (sweep.points, sweep.points[~sweep.is_ground], sweep.points[~mine])
    assert [has_ground(cloud) for cloud in clouds] == [True, False, False]
    with HDF5Log(kitti_file) as log:
        sweep = log.sweep(7)
        assert overlap(find_ground(sweep.points), sweep.is_ground) > 0.93


def test_patchwork_finds_the_ground_at_any_height():
    pytest.importorskip("pypatchworkpp")
    sweep = make_drive(seed=SEED, num_sweeps=1, profile="av2").sweep(0)
    for shift in (0.0, 1.7):
        mask = find_ground(sweep.points + np.array([0, 0, shift], np.float32), method="patchwork")
        assert overlap(mask, sweep.is_ground) > 0.8


def test_finding_ground_keeps_given_masks_and_adds_those_of_the_history():
    """A car that moves 0.8 m on the floor."""
    floor, car = rings(1.7, beams=32), block((8, -1, -1.5), (12, 0.8, 0.0), 3000, 6)
    older, pc0, pc1 = (np.concatenate([car + [0.8 * step, 0, 0], floor]) for step in (-1, 0, 1))
    mine = np.arange(len(pc0)) < len(car)  # not ground, but the user's mask counts
    result = estimate_flow(pc0, pc1, gm0=mine, ground="grid", preset="paper")
    assert not result.is_valid[mine].any() and result.is_valid[~mine].any()
    settings = {"num_history": 1, "preset": "paper"}
    gm0, gm1, gmh = find_ground_batch([pc0, pc1, older])
    masked = estimate_flow(Sweep(pc0, gm0), Sweep(pc1, gm1), history=[Sweep(older, gmh)], **settings)
    found = estimate_flow(Sweep(pc0), Sweep(pc1), history=[Sweep(older)], ground="grid", **settings)
    assert_same(found, masked)
    assert np.allclose(found.residual_flow[(mine & ~gm0)], [0.8, 0, 0], atol=1e-6)
