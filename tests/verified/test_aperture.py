"""The aperture rule: the reference's answers on random lines, principal axes by NumPy, known ones by hand."""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Set, Tuple

import numpy as np
import oracle as ref
import pytest
import torch
from scenes import needs_gpu

from cflow_torch.verified.aperture import slides_along_itself
from cflow_torch.verified.height_slices import Cells, cells_of_image
from cflow_torch.windows.bev_grid import Grid

HEIGHT, WIDTH = 61, 83
Pixels = Set[Tuple[int, int]]


class Scene(NamedTuple):
    """A window: per component its pixels by sweep, other pixels by sweep, time of each sweep, candidates (A, C, 2)."""

    components: List[Dict[int, Pixels]]
    others: Dict[int, Pixels]
    times: List[float]
    candidates: np.ndarray


def occupied(scene: Scene) -> Dict[int, Pixels]:
    members = {m: {p for c in scene.components for p in c.get(m, ())} for m in range(len(scene.times))}
    return {m: members[m] | scene.others.get(m, set()) for m in members}


def line(rng: np.random.Generator, start, direction: float, length: float, noise: float) -> Pixels:
    count = rng.integers(1, 60)
    along, across = rng.uniform(0, length, count), rng.normal(0, noise, count)
    y = start[0] + along * np.sin(direction) + across * np.cos(direction)
    x = start[1] + along * np.cos(direction) - across * np.sin(direction)
    inside = (y >= 0) & (y < HEIGHT) & (x >= 0) & (x < WIDTH)
    return {(int(r), int(c)) for r, c in zip(y[inside], x[inside])}


def random_scene(rng: np.random.Generator, num_sweeps: int) -> Scene:
    """Lines that stand, lines that move, lines that are longer than seen before; some thick, some short."""
    taken: Dict[int, Pixels] = {m: set() for m in range(num_sweeps)}
    components, candidates = [], []
    for _ in range(8):
        start, direction = rng.uniform((0, 0), (HEIGHT, WIDTH)), rng.choice([rng.uniform(0, 7), 0, np.pi / 2])
        length, noise = rng.uniform(10, 70), rng.choice([0.5, 2, 4])
        step = rng.choice([0, 0, 6, 30]) * np.array([np.sin(direction), np.cos(direction)])
        component = {}
        for m in range(num_sweeps):
            if m == 0 or rng.random() < 0.9:
                component[m] = line(rng, start - m * step, direction, length, noise) - taken[m]
                taken[m] |= component[m]
        components.append(component)
        along = direction + rng.choice([0, 0.1, np.pi, 0.6], 4)
        size = rng.uniform(0, 30, 4) / max(num_sweeps - 1, 1)
        candidates.append(np.column_stack([size * np.sin(along), size * np.cos(along)]) * [[1], [1], [1], [0]])
    stray = {m: line(rng, (0, 0), 0.7, 80, 20) - taken[m] for m in range(num_sweeps)}
    return Scene(components, stray, [float(m) for m in range(num_sweeps)], np.array(candidates))


def as_tensors(scenes: List[Scene], size: float):
    """Cells, elapsed times, owners and candidates of a batch."""
    num_steps = max(len(scene.times) for scene in scenes)
    image = np.zeros((len(scenes), num_steps, HEIGHT, WIDTH), dtype=np.uint8)
    total = sum(len(scene.components) for scene in scenes)
    owner = np.full(image.shape, total)
    elapsed, base = np.zeros((len(scenes), num_steps)), 0
    for window, scene in enumerate(scenes):
        elapsed[window, : len(scene.times)] = scene.times
        for m, pixels in occupied(scene).items():
            for r, c in pixels:
                image[window, m, r, c] = 1 + (r + c) % 15
        for i, component in enumerate(scene.components):
            for m, pixels in component.items():
                for r, c in pixels:
                    owner[window, m, r, c] = base + i
        base += len(scene.components)
    grid = Grid(size, (0.0, 0.0, -1.0), ((WIDTH - 0.5) * size, (HEIGHT - 0.5) * size, 1.0))
    assert (grid.height, grid.width) == (HEIGHT, WIDTH)
    flat = torch.from_numpy(np.append(image.ravel(), np.uint8(0)))
    cells = cells_of_image(flat, grid, len(scenes), num_steps)
    owners = torch.from_numpy(owner.ravel()).index_select(0, cells.pixel)
    candidates = torch.from_numpy(np.concatenate([scene.candidates for scene in scenes]))
    return cells, torch.from_numpy(elapsed), owners, candidates


def expected(scene: Scene, size: float) -> list:
    return [
        ref.slides_along_itself(component, occupied(scene), max(scene.times), candidates, size)
        for component, candidates in zip(scene.components, scene.candidates)
    ]


@pytest.mark.parametrize("size", [0.1, 0.2, 0.15])
def test_answers_equal_the_reference_in_a_batch_and_alone(size):
    rng = np.random.default_rng(int(100 * size))
    slid = stayed = 0
    for _ in range(6):
        scenes = [random_scene(rng, num_sweeps) for num_sweeps in (2, 4, 3)]
        ours = slides_along_itself(*as_tensors(scenes, size))
        theirs = [answers for scene in scenes for answers in expected(scene, size)]
        assert ours.tolist() == theirs
        alone = [slides_along_itself(*as_tensors([scene], size)) for scene in scenes]
        assert torch.equal(torch.cat(alone), ours)
        slid, stayed = slid + int(ours.sum()), stayed + int((~ours).sum())
    assert slid > 20 and stayed > 100


@pytest.mark.parametrize("seed", range(20))
def test_principal_axes_equal_eigenvectors(seed):
    rng = np.random.default_rng(seed)
    pixels = sorted(line(rng, (30, 40), rng.uniform(0, 7), 60, rng.choice([0.5, 3, 12])))
    is_line, y, x = ref.principal_axis(pixels, 0.1)
    values, vectors = np.linalg.eigh(np.cov(np.array(pixels).T, ddof=0).reshape(2, 2) if len(pixels) > 1 else np.eye(2))
    if min(abs(values[0] - 9), abs(values[1] - 100)) > 1e-6:
        assert is_line == (values[0] <= 9 and values[1] >= 100)
    if len(pixels) > 1 and values[1] - values[0] > 1e-6:
        assert abs(y * vectors[1, 1] - x * vectors[0, 1]) <= 1e-9 * np.hypot(y, x)


def rail(start: int, stop: int, row: int = 30) -> Pixels:
    return {(row, c) for c in range(start, stop)}


def one(component: Dict[int, Pixels], motion, times=(0.0, 1.0), others=None, size: float = 0.1) -> bool:
    scene = Scene([component], others or {}, list(times), np.array([[motion]], dtype=np.float64))
    answer = slides_along_itself(*as_tensors([scene], size)).tolist()
    assert answer == expected(scene, size)
    return answer[0][0]


def test_a_rail_that_stays_slides_and_one_that_leaves_does_not():
    assert one({0: rail(10, 60), 1: rail(10, 60)}, (0, 12))
    assert one({0: rail(10, 60), 1: rail(10, 60)}, (0, -12))
    assert not one({0: rail(30, 80), 1: rail(10, 60)}, (0, 20))
    assert not one({0: rail(10, 60), 1: rail(10, 60)}, (0, 0))
    assert not one({0: rail(10, 60), 1: rail(10, 60)}, (12, 0))


def test_what_stands_there_need_not_belong_to_the_component():
    assert one({0: rail(30, 80), 1: rail(10, 60)}, (0, 20), others={0: rail(2, 30), 1: rail(60, 82)})


def test_exactly_the_least_way_and_the_share():
    still = {0: rail(10, 60), 1: rail(10, 60)}
    way = 1.2 / 0.1
    assert one(still, (0, way)) and not one(still, (0, np.nextafter(way, 0)))
    assert one({**still, 3: rail(10, 60)}, (0, way / 3), times=(0.0, 1.0, 2.0, 3.0), others={2: rail(10, 60)})
    # Of 80 looks 8, 10, 16 and 24 find nothing in their cell of four pixels or beside it; 12 may.
    assert [one({0: rail(0, 40), 1: rail(s, s + 40)}, (0, 13)) for s in (8, 10, 12, 16)] == [True, True, False, False]
    for last, slides in ((52, True), (53, False)):  # 12 and 13 of 80
        assert one({0: rail(0, 40), 1: rail(11, last) - rail(30, last - 21)}, (0, 13)) == slides


def test_a_line_of_exactly_the_largest_width():
    # Two rows, each 2 pixels from the middle: a standard deviation of exactly 0.3 m.
    for last, is_line in ((32, True), (33, False)):
        two = {(r, c) for r in (28, last) for c in range(10, 70)}
        assert one({0: two, 1: two}, (0, 12), size=0.15) == is_line


def test_nothing_in_nothing_out():
    scene = Scene([], {}, [0.0, 1.0], np.zeros((0, 3, 2)))
    assert slides_along_itself(*as_tensors([scene], 0.1)).shape == (0, 3)
    missing = Scene([{1: rail(10, 60)}, {}], {}, [0.0, 1.0], np.full((2, 1, 2), 20.0))
    assert slides_along_itself(*as_tensors([missing], 0.1)).tolist() == [[False], [False]] == expected(missing, 0.1)


@pytest.mark.cuda
@needs_gpu
def test_on_cuda_as_on_cpu():
    rng = np.random.default_rng(3)
    cells, *rest = as_tensors([random_scene(rng, n) for n in (2, 4)], 0.1)
    lists = (cells.image, cells.pixel, cells.window, cells.step, cells.row, cells.col, cells.slices)
    on_gpu = Cells(cells.grid, cells.num_windows, cells.num_steps, *(values.cuda() for values in lists))
    ours = slides_along_itself(on_gpu, *(values.cuda() for values in rest))
    assert torch.equal(ours.cpu(), slides_along_itself(cells, *rest))
