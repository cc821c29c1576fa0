"""Slow groups: the reference's bits, whatever the order and the company; slow motion is found, rest stays rest."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from moving_scenes import LOWER, Scene, as_scene, moving_scene, one_window
from oracle import slow as ref
from oracle.refinement import Point
from scenes import needs_gpu

from cflow_torch.verified.height_slices import cells_of_image, draw_slices, slice_of
from cflow_torch.verified.slow import leans, slow_motion


def cells_of(scene: Scene):
    batch, grid = scene.batch, scene.grid
    image = torch.zeros(scene.pixel_of_place.numel(), dtype=torch.uint8, device=scene.place.device)
    draw_slices(image, scene.place, slice_of(batch.positions[2], 0.5))
    image[-1] = 0
    cells = cells_of_image(image, grid, batch.num_windows, batch.num_steps)
    assert cells.pixel.numel() == len(scene.group)
    return cells


def elapsed_of(scene: Scene, cells) -> torch.Tensor:
    elapsed = torch.ones(len(scene.flow) + 1, dtype=torch.float64, device=scene.group.device)
    elapsed[scene.group] = scene.batch.elapsed[cells.window, 1]
    return elapsed[:-1]


def found(scene: Scene, asked=None) -> torch.Tensor:
    cells = cells_of(scene)
    asked = torch.ones(len(scene.flow), dtype=torch.bool, device=scene.group.device) if asked is None else asked
    return slow_motion(
        scene.batch, scene.place, cells, scene.pixel_of_place, scene.group, asked, elapsed_of(scene, cells)
    )


def expected(scene: Scene) -> torch.Tensor:
    """One window."""
    (steps,) = scene.batch.elapsed.tolist()
    grid, cells, num_groups = scene.grid, cells_of(scene), len(scene.flow)
    images = list(cells.image[:-1].view(-1, grid.height, grid.width).numpy())
    pixels = list(zip(cells.step.tolist(), cells.row.tolist(), cells.col.tolist()))
    of_pixel = scene.group.tolist()
    members = [[p for p, owner in zip(pixels, of_pixel) if owner == group] for group in range(num_groups)]
    wanted = [ref.leans(images, own) for own in members]
    assert wanted == leans(cells, scene.group, torch.ones(num_groups, dtype=torch.bool)).tolist()
    points = []
    for i, place in enumerate(scene.place.tolist()):
        pixel = int(scene.pixel_of_place[place])
        if pixel < len(of_pixel) and of_pixel[pixel] < num_groups and wanted[of_pixel[pixel]]:
            x, y, z = scene.batch.positions[:, i].tolist()
            layer = int(np.floor(z / grid.pixel_size)) % ref.NUM_LAYERS
            points.append(Point(0, int(scene.batch.image[i]), layer, of_pixel[pixel], x, y))
    result = ref.slow_motion(points, num_groups, steps[1], LOWER[:2], grid.pixel_size)
    return torch.tensor([(0.0, 0.0) if one is None else one for one in result], dtype=torch.float64).view(-1, 2)


def slow_scene(seed: int, snap: float = 0.0, pixel_size: float = 0.1, num_windows: int = 1) -> Scene:
    return moving_scene(seed, num_windows, 2, pixel_size, snap, num_points=150, speed=0.08, size=(0.2, 0.8))


@pytest.mark.parametrize("snap", [0.0, 1 / 16])
@pytest.mark.parametrize("pixel_size", [0.1, 0.2])
def test_bits_of_the_reference(pixel_size, snap):
    moved, rested = 0, 0
    for seed in range(16):
        scene = slow_scene(seed, snap, pixel_size)
        flow = found(scene)
        assert flow.numpy().tobytes() == expected(scene).numpy().tobytes()
        moved += int(flow.any(1).sum())
        rested += int((~flow.any(1)).sum())
    assert moved > 1 and rested > 1


def test_batch_is_the_loop():
    scene = slow_scene(2, 1 / 16, num_windows=6)
    together = found(scene)
    assert together.any()
    for window in range(6):
        alone, groups = one_window(scene, window)
        assert torch.equal(found(alone), together[groups])


def test_order_of_points():
    scene = slow_scene(1, 0.05, num_windows=3)
    order = torch.randperm(len(scene.place), generator=torch.Generator().manual_seed(0))
    batch = dataclasses.replace(
        scene.batch,
        positions=scene.batch.positions[:, order],
        takes_part=scene.batch.takes_part[order],
        image=scene.batch.image[order],
    )
    assert torch.equal(found(scene._replace(batch=batch, place=scene.place[order])), found(scene))


def test_only_what_is_asked():
    scene = slow_scene(2, num_windows=6)
    flow = found(scene)
    asked = torch.arange(len(flow)) % 2 == 0
    assert flow[~asked].any()
    assert torch.equal(found(scene, asked), flow.masked_fill(~asked[:, None], 0.0))


def test_nothing_to_look_at():
    assert not found(slow_scene(0), torch.zeros(len(slow_scene(0).flow), dtype=torch.bool)).any()


def person(shift, rng) -> np.ndarray:
    """An upright cylinder, sampled anew."""
    angle, height = rng.uniform(0, 2 * np.pi, 400), rng.uniform(0.0, 1.5, 400)
    return np.stack((0.25 * np.cos(angle) + shift[0], 0.25 * np.sin(angle) + shift[1], height), 1)


@pytest.mark.parametrize("truth", [(0.07, 0.0), (0.0, -0.09), (-0.05, 0.06), (0.12, 0.1)])
def test_finds_a_slow_person(truth):
    rng = np.random.default_rng(0)
    scene = as_scene([person(truth, rng), person((0.0, 0.0), rng)], [np.zeros(2)])
    flow = found(scene)[0].numpy()
    assert np.linalg.norm(flow - truth) < 0.025
    scene.batch.elapsed[:, 1] = 2.0  # the same way in twice the time
    np.testing.assert_array_equal(found(scene)[0].numpy(), flow / 2)


def test_rest_stays_rest():
    """Sampled anew a hundred times, a person who stands is never moved."""
    rng = np.random.default_rng(1)
    scenes = [as_scene([person((0.03, 0.02), rng), person((0.03, 0.02), rng)], [np.zeros(2)]) for _ in range(100)]
    assert sum(bool(found(scene).any()) for scene in scenes) == 0


@pytest.mark.cuda
@needs_gpu
def test_same_bits_on_the_gpu():
    scene = slow_scene(2, 1 / 16, num_windows=6)
    batch = dataclasses.replace(
        scene.batch,
        **{
            name: getattr(scene.batch, name).cuda()
            for name in ("positions", "takes_part", "image", "elapsed", "seconds")
        },
    )
    tensors = {name: getattr(scene, name).cuda() for name in ("place", "pixel_of_place", "group", "flow")}
    assert torch.equal(found(scene._replace(batch=batch, **tensors)).cpu(), found(scene))
