"""The spacing of points: measured as the oracle does, wide where a sensor is sparse; sparse static walls are static."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle import spacing as oracle
from oracle.height_slices import SlicedSweeps
from scenes import sweeps_of

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.config import VerifiedConfig
from cflow_torch.verified import motion_margin, spacing
from cflow_torch.verified.columns import SLICE_HEIGHT
from cflow_torch.verified.spacing import Spacing
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch

REGION = (-40.0, -30.0, -3.0, 40.0, 30.0, 8.0)
SETTINGS = VerifiedConfig(pixel_sizes=(0.2,), point_cloud_range=REGION, num_history=4, min_height=None)


def rings(degrees: float, seed: int, walls: float = 25.07, noise: float = 0.2) -> np.ndarray:
    """Sixteen rings of beams, two degrees apart, of which each hits a wall to the left or to the right."""
    rng = np.random.default_rng(seed)
    azimuth = np.radians(np.arange(0, 360, degrees) + rng.uniform(0, degrees))
    azimuth = azimuth + rng.normal(0, math.radians(noise * degrees), len(azimuth))
    azimuth, elevation = (each.ravel() for each in np.meshgrid(azimuth, np.radians(np.arange(-2, 30, 2))))
    distance = walls / np.maximum(np.abs(np.sin(azimuth)), 0.3)
    return np.stack((*(distance * (np.cos(azimuth), np.sin(azimuth))), distance * np.tan(elevation)), 1)


def spacing_of(clouds: list[np.ndarray], settings: VerifiedConfig = SETTINGS) -> tuple[Spacing, Grid]:
    """The spacing of windows whose sweep t+1 is given."""
    grid = Grid(settings.pixel_sizes[-1], settings.point_cloud_range[:3], settings.point_cloud_range[3:])
    windows = [Window(Sweep(cloud), Sweep(cloud)) for cloud in clouds]
    return Spacing.of(make_batch(windows, settings, grid, torch.device("cpu"), 3), grid, SLICE_HEIGHT), grid


def test_pixels_whose_middle_is_on_an_axis_have_the_reach_of_their_distance():
    grid = Grid(0.1, (-55.25, -55.25, -3.0), (55.25, 55.25, 3.0))
    angle = torch.tensor([math.radians(1.0)]).double()
    spacing = Spacing(angle, angle, 6, True)
    row_col = torch.stack((torch.full((1105,), 552 + 450), torch.arange(1105)))  # 45 m from the x axis
    window = torch.zeros(1105, dtype=torch.int64)
    assert spacing.reach(grid, window, row_col).unique().tolist() == [6]
    assert spacing.are_tall(grid, window, row_col, SLICE_HEIGHT).all()


def test_the_angle_is_that_between_beams_and_as_the_oracle_measures_it():
    clouds = [
        rings(1.2, 0),
        rings(0.3, 1),
        np.zeros((0, 3)),
        rings(1.2, 2)[:90],
        rings(2.0, 3, walls=8.0)[:, [1, 0, 2]],
    ]
    found, grid = spacing_of(clouds)
    inside = [cloud[(np.abs(cloud) <= (40, 30, 8)).all(1)].astype(np.float32) for cloud in clouds]
    expected = [oracle.spacing_of(cloud.astype(np.float64)) for cloud in inside]
    assert list(zip(found.angle.tolist(), found.rise.tolist())) == expected
    assert np.degrees(found.rise.numpy()[:2]) == pytest.approx(2.0, abs=0.2)
    degrees = np.degrees(found.angle.numpy())
    assert degrees[:2] == pytest.approx([1.2, 0.3], abs=0.1) and degrees[2] == degrees[3] == 0
    for window, angle in enumerate(found.angle.tolist()):
        rows, cols = torch.meshgrid(torch.arange(grid.height), torch.arange(grid.width), indexing="ij")
        every = (torch.full((rows.numel(),), window), torch.stack((rows.flatten(), cols.flatten())))
        reach = found.reach(grid, *every).view_as(rows).numpy()
        assert np.array_equal(reach, oracle.reach_of_pixels(angle, SETTINGS))
        tall = found.are_tall(grid, *every, SLICE_HEIGHT).view_as(rows).numpy()
        assert np.array_equal(tall, oracle.are_tall(expected[window][1], SETTINGS))
    assert found.most == 6 and found.has_tall


def test_dense_sweeps_are_looked_up_in_three_by_three_pixels():
    cloud = np.random.default_rng(0).uniform((-40, -30, 0), (40, 30, 2), (20_000, 3))
    found, _ = spacing_of([cloud])
    assert found.most == 1 and not found.has_tall


def test_the_slices_around_are_those_within_the_reach():
    # Alone and beside a dense window, which has a reach of one pixel.
    clouds = [rings(1.2, seed) for seed in range(3)]
    window = Window(Sweep(clouds[1]), Sweep(clouds[0]), (Sweep(clouds[2]),))
    dense = np.random.default_rng(0).uniform((-40, -30, 0), (40, 30, 2), (20_000, 3))
    for windows in ([window], [Window(Sweep(dense), Sweep(dense)), window]):
        sweeps = sweeps_of(windows, SETTINGS)
        own = torch.nonzero(sweeps.pixels.window == len(windows) - 1)[:, 0]
        pixels = sweeps.pixels[own]
        inside = [cloud[(np.abs(cloud) <= (40, 30, 8)).all(1)].astype(np.float32).astype(float) for cloud in clouds]
        angle, rise = oracle.spacing_of(inside[0])
        reach, tall = oracle.reach_of_pixels(angle, SETTINGS), oracle.are_tall(rise, SETTINGS)
        expected = SlicedSweeps(inside, [0.0, 1.0, 2.0], [0.0, 0.1, 0.2], SETTINGS, reach, tall)
        assert tall.any() and not tall.all()
        assert len(pixels) == len(expected.pixels) and len(np.unique(reach[tuple(expected.pixels[:, 1:].T)])) > 2
        _, row, col = expected.pixels.T
        for step in range(3):
            found = sweeps.columns.look_up(pixels, step).numpy()
            assert np.array_equal(found, expected.both[step, row, col])


def test_a_pixel_in_the_corner_of_the_region_is_around_no_empty_place():
    # At the corner, the reach is several pixels. Beyond the border, no sweep has anything, nor has it around there.
    cloud = np.concatenate((rings(1.2, 0), [[-39.99, -29.99, 0.2]]))
    sweeps = sweeps_of([Window(Sweep(cloud), Sweep(cloud))], SETTINGS)
    row, col = sweeps.pixels.row_col
    assert sweeps.columns.reach.max() > 1 and ((row == row.min()) & (col == col.min())).any()
    assert not sweeps.columns.slices[0].any()


def test_a_wall_that_a_sparse_sensor_samples_elsewhere_in_each_sweep_is_static(monkeypatch):
    settings = make_config("default", point_cloud_range=REGION)
    window = Window(Sweep(rings(1.2, 0)), Sweep(rings(1.2, 1)), tuple(Sweep(rings(1.2, 2 + seed)) for seed in range(4)))
    assert VerifiedFlow(settings)([window])[0].residual_flow.any(1).double().mean() < 0.02
    monkeypatch.setattr(spacing, "_FARTHEST", 1)
    monkeypatch.setattr(motion_margin, "_LEAST_LIKELY", 4 * (0.0,))  # also motions that are hardly ever right
    assert VerifiedFlow(settings)([window])[0].residual_flow.any(1).double().mean() > 0.1
