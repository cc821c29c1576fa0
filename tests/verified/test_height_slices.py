"""Height slices and neighbourhoods by hand; the oracle's ground residue and slopes; a car on a ramp climbs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_scenes import from_images
from oracle.height_slices import NUM_SLICES, ground_slope, is_residue, slice_of
from oracle.pixels import in_range
from oracle.sweeps import compensate, ground_points
from preset_windows import changed
from scenes import RANGE, config, same_bits, scene, sweeps_of
from turning_car import MODEL, REGION, turning_car

from cflow_torch import Sweep, VerifiedFlow, Window
from cflow_torch.ground.heights import GroundHeights
from cflow_torch.verified.columns import BORDER, OWN, count_slices
from cflow_torch.verified.height_slices import SLICE_HEIGHT, HeightSlicedSweeps, layer_of, pack_bits

SIZE = 0.25
PLAIN = config("verified", min_height=None, num_history=3)
SETTINGS = config("verified", min_height=0.4, num_history=1)
LOW, HIGH = np.array(RANGE[:3]), np.array(RANGE[3:])


def drawn(sweeps: HeightSlicedSweeps) -> np.ndarray:
    """Bytes of all positions of B windows, then of B windows of copies, and S sweeps, (2 B, S, H, W)."""
    columns = sweeps.columns
    images = columns.image.view(-1, columns.grid.height + 2 * BORDER, columns.lattice.stride)
    column = images[:, BORDER:-BORDER, BORDER:-BORDER].long()
    return columns.slices[:, : sweeps.num_steps][column].permute(0, 3, 1, 2).numpy()


def test_upper_bits_hold_the_slices_around_and_rows_do_not_touch():
    images = np.zeros((2, 2, 9, 11), dtype=np.uint8)
    images[0, 0, 0, 10], images[0, 0, 1, 0], images[1, 1, 4, 5], images[1, 1, 5, 6] = 1, 2, 4, 8
    sweeps = from_images(images)
    found, of_copies = np.split(drawn(sweeps), 2)
    assert np.array_equal(found & OWN, images) and not of_copies.any()
    for window, step, row, col in np.ndindex(*images.shape):
        around = images[window, step, max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2]
        assert found[window, step, row, col] >> NUM_SLICES == np.bitwise_or.reduce(around, axis=None)
    border = sweeps.columns.image.view(-1, 13, 15)
    assert not border[:, [0, 1, -1, -2]].any() and not border[:, :, [0, 1, -1, -2]].any()


def test_a_look_up_reads_the_shifted_pixel_of_another_sweep_and_nothing_outside():
    rng, num_steps = np.random.default_rng(3), 10  # more sweeps than a word has bytes
    images = (rng.random((2, num_steps, 9, 11)) < 0.1) * rng.integers(1, 16, (2, num_steps, 9, 11))
    sweeps = from_images(images.astype(np.uint8))
    pixels = sweeps.pixels
    step = torch.from_numpy(rng.integers(0, num_steps, len(pixels)))
    shift = torch.from_numpy(rng.integers(-14, 15, (len(pixels), 3, 2)))
    found = sweeps.columns.look_up(pixels, step, shift).numpy() & OWN
    wide = np.pad(images, ((0, 0), (0, 0), (30, 30), (30, 30)))
    row, col = (pixels.row_col.T[:, None] + shift).permute(2, 0, 1).numpy() + 30
    window = pixels.window[:, None].numpy()
    assert np.array_equal(found, wide[window, step[:, None].numpy(), row, col]) and found.any()
    words = sweeps.columns.words(pixels).view(torch.uint8)[:, :num_steps] & OWN
    row, col = pixels.row_col.numpy()
    assert np.array_equal(words.numpy(), images[pixels.window.numpy(), :, row, col])


def test_copies_are_columns_of_their_own():
    sweeps = sweeps_of([scene(0), scene(1)], PLAIN)
    before, rows = drawn(sweeps), torch.arange(0, 400, 7)
    rows = rows[sweeps.points[rows].is_member]
    own = sweeps.pixels[sweeps.points[rows].of_item]
    copies = sweeps.with_copies(rows)
    assert np.array_equal(drawn(copies)[:2], before[:2])
    of_copy = copies.pixels[copies.copies.of_item]
    assert torch.equal(of_copy.window, own.window + 2)
    assert all(torch.equal(getattr(of_copy, name), getattr(own, name)) for name in ("step", "row_col"))
    slices = copies.columns.look_up(of_copy, of_copy.step) & OWN
    assert torch.equal(slices, of_copy.slices) and bool((slices & ~own.slices == 0).all())
    points = layer_of(sweeps.batch.positions[2, rows], SLICE_HEIGHT).long() & 3
    assert bool(((slices.long() >> points) & 1).all()) and (slices != own.slices).any()
    around = copies.around(torch.arange(copies.num_pixels), 0)
    assert torch.equal(around.of_item, torch.arange(copies.num_pixels))


def test_slices_by_hand():
    z = torch.tensor([0.0, 0.49, 0.5, 1.0, 1.99, 2.0, -0.01, -0.5, -0.51, -2.0, 1e300, -1e300], dtype=torch.float64)
    assert (layer_of(z, 0.5) & 3).tolist() == [0, 0, 1, 2, 3, 0, 3, 3, 2, 0, 0, 0]
    assert (layer_of(z[:10], 0.1) & 15).tolist() == slice_of(z[:10].numpy(), 0.1, 16).tolist()
    infinite = torch.tensor([math.inf, -math.inf, math.nan], dtype=torch.float64)
    assert (layer_of(infinite, 0.5) & 3).tolist() == [0, 0, 0]
    every = torch.arange(16, dtype=torch.uint8)
    assert count_slices(every).tolist() == [bin(value).count("1") for value in range(16)]
    flags = (every[:, None] >> torch.arange(4)) & 1
    assert pack_bits(flags.bool()).tolist() == every.tolist()


def random_window(seed: int) -> Window:
    """Sloped ground with a mask, remnants of it without, some posts; every third has no masks."""
    rng = np.random.default_rng(seed)
    slope, sweeps = rng.normal(0, 0.05, 2), []

    def on_ground(count: int, noise: float) -> np.ndarray:
        xy = rng.uniform(LOW[:2] - 1, HIGH[:2] + 1, (count, 2))
        return np.column_stack([xy, xy @ slope - 1 + rng.normal(0, noise, count)])

    for _ in range(3):
        ground, remnants = on_ground(int(rng.integers(0, 150)), 0.05), on_ground(int(rng.integers(0, 120)), 0.3)
        ground[:3] = np.array([[np.nan], [np.inf], [-np.inf]])[: len(ground)]
        posts = on_ground(int(rng.integers(1, 12)), 0.1).repeat(6, 0)
        posts += rng.uniform(-0.3, 0.3, posts.shape) + [0, 0, 0.4]
        mask = np.repeat([True, False], [len(ground), len(remnants) + len(posts)])
        sweeps.append(Sweep(np.concatenate([ground, remnants, posts]), None if seed % 3 == 2 else mask))
    return Window(sweeps[0], sweeps[1], (sweeps[2],))


@pytest.mark.parametrize("seed", range(4))
def test_ground_residue_equals_the_oracle_in_a_batch(seed):
    windows, dropped = [random_window(4 * seed + i) for i in range(4)], 0
    sweeps = sweeps_of(windows, SETTINGS)
    batch, is_drawn = sweeps.batch, sweeps.points.is_member
    for number, window in enumerate(windows):
        clouds, cloud1 = compensate(window, SETTINGS)
        ground = ground_points(window.pc0, clouds[0])
        for step, cloud in enumerate((cloud1, *clouds)):
            inside = cloud.is_active & in_range(cloud.points, SETTINGS)
            expected = ~is_residue(cloud.points[inside], ground, SETTINGS)
            rows = (batch.image == number * batch.num_steps + step) & batch.is_active
            assert is_drawn[rows].tolist() == expected.tolist()
            dropped += int((~expected).sum())
    assert dropped > 20


def test_ground_heights_do_not_depend_on_the_order_of_points_nor_overflow():
    rng = np.random.default_rng(5)
    points = torch.from_numpy(rng.uniform(RANGE[:3], RANGE[3:], (400, 3)).T.copy())
    sums = [GroundHeights(1, RANGE[:3], RANGE[3:], torch.device("cpu")) for _ in range(3)]
    sums[0].add(0, points)
    for part in points[:, torch.from_numpy(rng.permutation(400))].split(70, 1):
        sums[1].add(0, part)
    assert same_bits(sums[0].mean(), sums[1].mean())
    sums[2].add(0, torch.tensor([[1.0] * 6, [2.0] * 6, [1e300] * 6], dtype=torch.float64))
    assert sums[2].mean().max() == 10**10


def test_ground_counts_of_the_newest_pair_only():
    one, other = random_window(0), random_window(1)
    heights = sweeps_of([one, other], SETTINGS).batch.ground
    pairs = [Window(window.pc0, window.pc1) for window in (one, other)]
    assert same_bits(heights.mean(), sweeps_of(pairs, SETTINGS).batch.ground.mean())
    assert sweeps_of([one], config("verified", min_height=None, num_history=1)).batch.ground is None


def slopes(points: np.ndarray, centres: np.ndarray) -> torch.Tensor:
    """(5, 2), which are the oracle's, whatever the order of the points."""
    found, window = [], torch.zeros(len(centres), dtype=torch.int64)
    for order in (slice(None), slice(None, None, -1)):
        heights = GroundHeights(1, REGION[:3], REGION[3:], torch.device("cpu"))
        heights.add(0, torch.from_numpy(points[order].T.copy()))
        found.append(heights.slopes(torch.from_numpy(centres), window))
    assert torch.equal(*found)
    expected = [ground_slope(points, (x, y), MODEL) for x, y in centres.tolist()]
    np.testing.assert_allclose(found[0], expected, atol=1e-9)
    return found[0]


def noisy_slope(rng: np.random.Generator) -> np.ndarray:
    """Parts of a noisy plane, a fifth of it raised."""
    points = rng.uniform(-8, 8, (int(rng.integers(20, 500)), 3))
    points[:, 2] = points[:, :2] @ rng.normal(0, 0.15, 2) + rng.normal(0, 0.03, len(points)) - 1.7
    points[: len(points) // 5, 2] += rng.uniform(0, 0.5)
    return points[(np.abs(points[:, 2] - 1) <= 4) & (points[:, 0] < rng.uniform(-4, 9))]


def rough_ground(rng: np.random.Generator) -> np.ndarray:
    """Few of its blocks are near a plane: too few of them, or on a line."""
    points = rng.uniform(-8, 8, (300, 3))
    points[:, 2] = rng.normal(0, 0.2, (9, 9))[tuple((points[:, :2] // 2).astype(int).T)] - 1.7
    return points


@pytest.mark.parametrize("ground, count", [(noisy_slope, 30), (rough_ground, 100)])
def test_slopes_equal_the_oracle_in_any_order(ground, count):
    generators = [np.random.default_rng(seed) for seed in range(count)]
    known = sum(int(slopes(ground(rng), rng.uniform(-9, 9, (5, 2))).any(1).sum()) for rng in generators)
    assert 20 < known < 5 * count - 20


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
