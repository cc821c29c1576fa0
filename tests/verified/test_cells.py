"""Height slices of all sweeps: equal to the loop over points, whatever the order, the batch, the pixels left out."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from oracle.cells import slice_image
from oracle.pixels import in_range
from oracle.sweeps import compensate
from scenes import RANGE, config, needs_gpu, same_bits, scene

from cflow_torch import CFlowError, Sweep, Window
from cflow_torch.config import Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of_log
from cflow_torch.verified.height_slices import Cells, count_slices, draw_slices, make_cells, slice_of
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch, make_batch

SIZE, SLICE = 0.25, 0.5
GRID = Grid(SIZE, RANGE[:3], RANGE[3:])
LISTS = ("pixel", "window", "step", "row", "col", "slices")


def with_heights(windows, device="cpu", **overrides) -> Batch:
    return make_batch(windows, config(sectional_view=True, num_history=3, **overrides), GRID, device)


def images(cells: Cells) -> torch.Tensor:
    """(B, S, H, W) uint8."""
    return cells.image[:-1].view(cells.num_windows, cells.num_steps, cells.grid.height, cells.grid.width)


def expected(window: Window, slice_height: float = SLICE):
    clouds, cloud1 = compensate(window, config(num_history=3))
    for cloud in (cloud1, *clouds):
        points = cloud.points[cloud.takes_part & in_range(cloud.points, config())]
        yield slice_image(points, config(), SIZE, slice_height)


@pytest.mark.parametrize("slice_height", [0.5, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_cells_equal_the_loop_over_points(seed, slice_height):
    window = scene(seed, num_history=seed % 4)
    cells, _ = make_cells(with_heights([window]), GRID, slice_height)
    drawn = list(expected(window, slice_height))
    assert cells.num_steps == len(drawn)
    for found, image in zip(images(cells)[0], drawn):
        assert found.numpy().tobytes() == image.tobytes()
    assert cells.image[-1] == 0 and set(cells.image.tolist()) > {0, 1, 2, 4, 8}


def test_cells_of_the_real_pair(av2_folder):
    window, settings = window_of_log(AV2Log(av2_folder), 0), Config(sectional_view=True)
    grid = Grid(0.1, settings.point_cloud_range[:3], settings.point_cloud_range[3:])
    cells, _ = make_cells(make_batch([window], settings, grid, "cpu"), grid, SLICE)
    clouds, cloud1 = compensate(window, settings)
    for found, cloud in zip(images(cells)[0], (cloud1, *clouds)):
        points = cloud.points[cloud.takes_part & in_range(cloud.points, settings)]
        assert found.numpy().tobytes() == slice_image(points, settings, 0.1, SLICE).tobytes()
    assert cells.pixel.numel() > 25_000


def test_every_point_knows_its_pixel():
    batch = with_heights([scene(5, num_history=2)])
    cells, place = make_cells(batch, GRID, SLICE)
    assert same_bits(place == cells.image.numel() - 1, ~batch.takes_part)
    inside = batch.takes_part.nonzero()[:, 0]
    drawn = torch.zeros_like(cells.image, dtype=torch.bool)
    drawn[place[inside]] = True
    assert same_bits(drawn, cells.image != 0)


def test_the_list_says_where_the_occupied_pixels_are():
    cells, _ = make_cells(with_heights([scene(1, num_history=2), scene(2)]), GRID, SLICE)
    assert cells.pixel.tolist() == cells.image.nonzero()[:, 0].tolist()
    at = images(cells)[cells.window, cells.step, cells.row, cells.col]
    assert same_bits(at, cells.slices) and bool((at != 0).all())
    assert same_bits(cells.place(cells.window, cells.step, cells.row, cells.col), cells.pixel)
    number = cells.number()
    assert number[cells.pixel].tolist() == list(range(cells.pixel.numel()))
    assert set(number[cells.image == 0].tolist()) == {cells.pixel.numel()}
    at_t = torch.cat((cells.pixel[cells.step == 1], cells.pixel.new_tensor([cells.image.numel() - 1])))
    assert same_bits(cells.number_at_t()[at_t], number[at_t])


def test_what_lies_outside_the_image_is_empty():
    cells, _ = make_cells(with_heights([scene(1)]), GRID, SLICE)
    row = torch.tensor([-1, GRID.height, 0, 0, -(1 << 40), GRID.height - 1])
    col = torch.tensor([0, 0, -1, GRID.width, 1 << 40, GRID.width - 1])
    zero = torch.zeros(1, dtype=torch.int64)
    nowhere = cells.image.numel() - 1
    assert cells.place(zero, zero, row, col).tolist() == [nowhere] * 5 + [GRID.height * GRID.width - 1]
    assert cells.look_up(cells.place(zero, zero, row, col).view(2, 3)).shape == (2, 3)


def test_order_of_points_does_not_matter():
    window = scene(3, num_history=1)
    order = np.random.default_rng(0).permutation(len(window.pc0.points))
    other = Window(
        Sweep(window.pc0.points[order], window.pc0.is_ground[order], window.pc0.pose), window.pc1, window.pch
    )
    batch = with_heights([window])
    a, place_a = make_cells(batch, GRID, SLICE)
    b, place_b = make_cells(with_heights([other]), GRID, SLICE)
    assert same_bits(a.image, b.image)
    rows = batch.sources[0].points
    assert same_bits(place_a[rows][torch.from_numpy(order)], place_b[rows])


def test_batch_equals_loop():
    windows = [scene(seed, num_history=seed % 4) for seed in range(3)]
    together, _ = make_cells(with_heights(windows), GRID, SLICE)
    for index, window in enumerate(windows):
        alone, _ = make_cells(with_heights([window]), GRID, SLICE)
        assert same_bits(images(together)[index, : alone.num_steps], images(alone)[0])
        assert not images(together)[index, alone.num_steps :].any()


def test_slices_of_heights_by_hand():
    z = torch.tensor(
        [0.0, 0.49, 0.5, 1.0, 1.99, 2.0, -0.01, -0.5, -0.51, -2.0, 1e300, -1e300, 2.0**53], dtype=torch.float64
    )
    assert slice_of(z, 0.5).tolist() == [0, 0, 1, 2, 3, 0, 3, 3, 2, 0, 0, 0, 0]
    infinite = torch.tensor([math.inf, -math.inf, math.nan], dtype=torch.float64)
    assert slice_of(infinite, 0.5).tolist() == [0, 0, 0]
    assert slice_of(torch.tensor([0.3 * 3], dtype=torch.float64), 0.3).tolist() == [int(0.3 * 3 / 0.3 // 1) % 4]


def test_slices_of_a_pixel_are_or_ed():
    place, part = torch.tensor([2, 2, 0, 2, 3, 2]), torch.tensor([0, 3, 1, 0, 2, 0], dtype=torch.uint8)
    image = torch.zeros(4, dtype=torch.uint8)
    draw_slices(image, place[:3], part[:3])
    draw_slices(image, place[3:], part[3:])
    assert image.tolist() == [2, 0, 9, 4]


def test_set_slices_are_counted():
    every = torch.arange(16, dtype=torch.uint8)
    assert count_slices(every).tolist() == [bin(value).count("1") for value in range(16)]


def test_nothing_to_draw():
    nothing = Sweep(np.zeros((0, 3)))
    cells, place = make_cells(with_heights([Window(nothing, nothing)]), GRID, SLICE)
    assert not cells.image.any() and place.shape == (0,) and cells.num_steps >= 1
    assert all(getattr(cells, name).shape == (0,) for name in LISTS)
    assert set(cells.number().tolist()) == {0}


def test_a_batch_without_heights_is_refused():
    with pytest.raises(CFlowError, match="three axes"):
        make_cells(make_batch([scene(0)], config(), GRID, "cpu"), GRID, SLICE)


@pytest.mark.cuda
@needs_gpu
def test_cells_on_cuda_equal_cpu():
    windows = [scene(seed, num_history=2) for seed in range(2)]
    a, place_a = make_cells(with_heights(windows), GRID, SLICE)
    b, place_b = make_cells(with_heights(windows, "cuda"), GRID, SLICE)
    assert same_bits(place_a, place_b) and same_bits(a.image, b.image)
    assert all(same_bits(getattr(a, name), getattr(b, name)) for name in LISTS)
