"""Low columns: the reference's points on random scenes, known ones by hand."""

from __future__ import annotations

import numpy as np
import oracle as ref
import pytest
import torch
from scenes import RANGE, config, needs_gpu

from cflow_torch.config import Config
from cflow_torch.data.av2 import AV2Log
from cflow_torch.data.log import window as window_of_log
from cflow_torch.verified.ground_residue import TALL, add_ground, empty_low_columns, ground_heights, is_tall, no_ground
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import make_batch

SIZE = 0.25
GRID = Grid(SIZE, RANGE[:3], RANGE[3:])
AREA = GRID.height * GRID.width


def random_scene(rng: np.random.Generator, num_sweeps: int, is_bare: bool):
    """(ground points of two sweeps, points of each sweep): sloped ground, remnants of it, some posts."""
    low, high = np.array(RANGE[:3]), np.array(RANGE[3:])
    slope = rng.normal(0, 0.05, 2)

    def on_ground(count, noise):
        xy = rng.uniform(low[:2] - 1, high[:2] + 1, (count, 2))
        return np.column_stack([xy, xy @ slope - 1 + rng.normal(0, noise, count)])

    ground = [on_ground(0 if is_bare else int(rng.integers(0, 150)), 0.05) for _ in range(2)]
    ground[1][:3] = np.nan, np.inf, -np.inf
    sweeps = []
    for _ in range(num_sweeps):
        remnants, posts = on_ground(int(rng.integers(0, 120)), 0.3), on_ground(int(rng.integers(0, 12)), 0.1)
        posts = posts.repeat(6, 0) + rng.uniform(-0.3, 0.3, (6 * len(posts), 3)) + [0, 0, 0.4]
        points = np.concatenate([remnants, posts])
        sweeps.append(points[((points >= low) & (points <= high)).all(1)])
    return ground, sweeps


def heights_of(scenes, order=lambda points: points, device="cpu") -> torch.Tensor:
    sums = no_ground(len(scenes), GRID, torch.device(device))
    for window, (ground, _) in enumerate(scenes):
        for points in ground:
            positions = torch.from_numpy(order(points).T.copy()).to(device)
            add_ground(sums, window, positions[:, GRID.contains(positions)], GRID)
    return ground_heights(sums)


def drop_low_columns(place, positions, ground, grid, num_steps, clearance) -> torch.Tensor:
    """(P,) int64, as `place`; points on pixels that are emptied are left out."""
    image = torch.zeros(len(ground) * num_steps * grid.height * grid.width + 1, dtype=torch.uint8, device=place.device)
    slices = torch.arange(len(place), device=place.device) % 15 + 1
    image[place] = slices.to(torch.uint8)  # any
    image[-1] = 0
    before, tall = image.clone(), is_tall(place, positions, ground, grid, num_steps, clearance)
    image[tall] = before[tall] | TALL
    pixel = empty_low_columns(image, before.nonzero()[:, 0], grid)
    assert pixel.tolist() == image.nonzero()[:, 0].tolist() and torch.equal(image[pixel], before[pixel])
    return torch.where(image[place] != 0, place, len(image) - 1)


def kept(scenes, num_steps: int, clearance: float = 0.4, device="cpu") -> list:
    """Per scene and sweep (N,) bool: whether each point still has a pixel. One point that is left out is added."""
    positions = torch.from_numpy(
        np.concatenate([p for _, sweeps in scenes for p in sweeps] + [np.full((1, 3), np.nan)]).T
    )
    image = [np.full(len(p), w * num_steps + m) for w, (_, sweeps) in enumerate(scenes) for m, p in enumerate(sweeps)]
    takes_part = torch.ones(positions.shape[1], dtype=torch.bool)
    takes_part[-1] = False
    num_images = len(scenes) * num_steps
    image_of_point = torch.from_numpy(np.concatenate([*image, [0]]))
    _, place = GRID.project(positions, image_of_point, num_images, takes_part)
    ground = heights_of(scenes, device=device)
    after = drop_low_columns(place.to(device), positions.to(device), ground, GRID, num_steps, clearance).cpu()
    nowhere = num_images * AREA
    assert after[-1] == nowhere
    assert torch.equal(after[after != nowhere], place[after != nowhere])
    split = (after[:-1] != nowhere).split([len(p) for p in image])
    found, sizes = iter(split), [len(sweeps) for _, sweeps in scenes]
    return [[next(found).numpy() for _ in range(size)] for size in sizes]


def expected(scene, clearance: float = 0.4) -> list:
    ground, sweeps = scene
    means = ref.ground_heights(ground, config())
    return [~ref.in_low_column(points, means, clearance, SIZE, config()) for points in sweeps]


@pytest.mark.parametrize("seed", range(12))
def test_heights_and_points_equal_the_reference_in_a_batch(seed):
    rng = np.random.default_rng(seed)
    scenes = [random_scene(rng, 3, is_bare=i == 2) for i in range(4)]
    ours = kept(scenes, 3)
    dropped = 0
    for window, scene in enumerate(scenes):
        means = ref.ground_heights(scene[0], config())
        table = heights_of(scenes)[window]
        known = {(r, c): int(table[r, c]) for r, c in np.argwhere(table.numpy() > -(1 << 30)).tolist()}
        assert known == means
        for mine, theirs in zip(ours[window], expected(scene)):
            assert mine.tolist() == theirs.tolist()
            dropped += int((~theirs).sum())
        assert [m.tolist() for m in kept([scene], 3)[0]] == [m.tolist() for m in ours[window]]
    assert dropped > 20


def test_the_order_of_ground_points_means_nothing():
    rng = np.random.default_rng(5)
    scenes = [random_scene(rng, 1, False) for _ in range(3)]
    assert torch.equal(heights_of(scenes), heights_of(scenes, order=rng.permutation))


def test_the_order_of_points_means_nothing():
    rng = np.random.default_rng(6)
    ground, sweeps = random_scene(rng, 2, False)
    before = kept([(ground, sweeps)], 2)[0]
    order = [rng.permutation(len(points)) for points in sweeps]
    after = kept([(ground, [points[rows] for points, rows in zip(sweeps, order)])], 2)[0]
    assert [mine.tolist() for mine in after] == [mine[rows].tolist() for mine, rows in zip(before, order)]
    assert not all(mine.all() for mine in before)


def flat(height: float, count: int = 5) -> np.ndarray:
    """Ground points in one block around (1, 2)."""
    return np.column_stack([np.full(count, 1.0), np.full(count, 2.0), np.full(count, height)])


def test_exactly_the_clearance_is_tall():
    column = np.array([[1.0, 2.0, -0.6]])
    for ground, stays in ((-1.0, True), (-0.99, False)):
        assert kept([([flat(ground)], [column])], 1)[0][0].tolist() == [stays]


def test_four_ground_points_say_nothing():
    column = np.array([[1.0, 2.0, -1.0]])
    assert kept([([flat(-1.0, 5)], [column])], 1)[0][0].tolist() == [False]
    assert kept([([flat(-1.0, 4)], [column])], 1)[0][0].tolist() == [True]
    assert kept([([flat(-1.0, 2), flat(-1.0, 3)], [column])], 1)[0][0].tolist() == [False]  # two sweeps


def test_ground_reaches_one_block_further():
    # Blocks begin at -8, -7 every two metres: the ground lies in columns 8 ... 10 = 0 ... 2 m.
    for x, stays in ((3.99, False), (4.0, True), (-2.0, False), (-2.01, True)):
        assert kept([([flat(-1.0)], [np.array([[x, 2.0, -1.0]])])], 1)[0][0].tolist() == [stays], x


def test_two_pixels_from_a_tall_column_belong_to_it():
    tall = [1.1, 2.1, 0.5]
    near, far = [1.1 + 2 * SIZE, 2.1 - 2 * SIZE, -1.0], [1.1 + 3 * SIZE, 2.1, -1.0]
    assert kept([([flat(-1.0)], [np.array([tall, near, far])])], 1)[0][0].tolist() == [True, True, False]
    # Not across sweeps, nor around the end of a row.
    assert [m.tolist() for m in kept([([flat(-1.0)], [np.array([tall]), np.array([near])])], 2)[0]] == [[True], [False]]
    edge = [[-8.0, 2.0, 2.0], [7.9, 2.0 - SIZE, -1.0]]
    everywhere = [np.random.default_rng(0).uniform(RANGE[:3], RANGE[3:], (600, 3)) * [1, 1, 0] + [0, 0, -1]]
    assert kept([(everywhere, [np.array(edge)])], 1)[0][0].tolist() == [True, False]


def test_heights_far_away_do_not_overflow():
    grid = Grid(SIZE, (-8.0, -7.0, -float("inf")), (8.0, 7.0, float("inf")))
    sums = no_ground(1, grid, torch.device("cpu"))
    add_ground(sums, 0, torch.tensor([[1.0] * 6, [2.0] * 6, [1e300] * 6], dtype=torch.float64), grid)
    assert ground_heights(sums).max() == 10**10
    place = grid.pixel(torch.tensor([[1.0], [2.0]], dtype=torch.float64)).long()
    point = torch.tensor([[1.0], [2.0], [-1e300]], dtype=torch.float64)
    assert drop_low_columns(place, point, ground_heights(sums), grid, 1, 0.4).tolist() == [AREA]
    unknown = ground_heights(no_ground(1, grid, torch.device("cpu")))
    assert drop_low_columns(place, point, unknown, grid, 1, 0.4).tolist() == place.tolist()


def test_the_real_pair(av2_folder):
    settings = Config(sectional_view=True)  # asks for heights
    grid = Grid(0.1, settings.point_cloud_range[:3], settings.point_cloud_range[3:])
    window = window_of_log(AV2Log(av2_folder), 0)
    batch = make_batch([window], settings, grid, "cpu")
    place = grid.pixel_of_image(batch.positions, batch.image, 2, batch.takes_part).long()
    clouds, cloud1 = ref.compensate(window, settings)
    ground = [
        cloud.points[np.asarray(sweep.is_ground)] for cloud, sweep in ((cloud1, window.pc1), (clouds[0], window.pc0))
    ]
    sums = no_ground(1, grid, torch.device("cpu"))
    for points in ground:
        positions = torch.from_numpy(points.T.copy())
        add_ground(sums, 0, positions[:, grid.contains(positions)], grid)
    after = drop_low_columns(place, batch.positions, ground_heights(sums), grid, 2, 0.4)
    means = ref.ground_heights(ground, settings)
    for step in (0, 1):
        points = (batch.image == step) & batch.takes_part
        low = ref.in_low_column(batch.positions[:, points].T.numpy(), means, 0.4, 0.1, settings)
        assert low.any() and torch.equal(after[points] != place[points], torch.from_numpy(low))
    assert torch.equal(after[~batch.takes_part], place[~batch.takes_part])


def test_nothing_in_nothing_out():
    nothing = np.zeros((0, 3))
    assert kept([([nothing], [nothing, nothing])], 2)[0][0].tolist() == []


@pytest.mark.cuda
@needs_gpu
def test_on_cuda_as_on_cpu():
    rng = np.random.default_rng(3)
    scenes = [random_scene(rng, 2, False) for _ in range(3)]
    cpu, gpu = kept(scenes, 2), kept(scenes, 2, device="cuda")
    assert [[m.tolist() for m in w] for w in cpu] == [[m.tolist() for m in w] for w in gpu]
