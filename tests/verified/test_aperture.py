"""The aperture rule: the oracle's answers on random lines, known ones by hand."""

from __future__ import annotations

from typing import Dict, List, NamedTuple, Sequence, Set, Tuple

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle, from_images
from oracle import aperture as oracle

from cflow_torch.verified.aperture import slides_along_itself

HEIGHT, WIDTH = 61, 83
Pixels = Set[Tuple[int, int]]


class Scene(NamedTuple):
    """A window: per component its pixels by sweep, other pixels by sweep, number of sweeps, candidates (A, C, 2)."""

    components: List[Dict[int, Pixels]]
    others: Dict[int, Pixels]
    num_sweeps: int
    candidates: np.ndarray


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
    return Scene(components, stray, num_sweeps, np.array(candidates))


def answers(scenes: Sequence[Scene], size: float = 0.1) -> List[List[bool]]:
    """Of a batch; they are those of the oracle."""
    num_steps = max(scene.num_sweeps for scene in scenes)
    image = np.zeros((len(scenes), num_steps, HEIGHT, WIDTH), dtype=np.uint8)
    owner = np.full(image.shape, sum(len(scene.components) for scene in scenes))
    elapsed, number = np.zeros((len(scenes), num_steps)), 0
    for window, scene in enumerate(scenes):
        elapsed[window, : scene.num_sweeps] = np.arange(scene.num_sweeps)
        for m, pixels in scene.others.items():
            for r, c in pixels:
                image[window, m, r, c] = 1
        for component in scene.components:
            for m, pixels in component.items():
                for r, c in pixels:
                    image[window, m, r, c], owner[window, m, r, c] = 1 + (r + c) % 15, number
            number += 1
    sweeps = from_images(image, size, elapsed)
    owners = torch.from_numpy(owner.ravel())[sweeps.pixel]
    candidates = torch.from_numpy(np.concatenate([scene.candidates for scene in scenes]))
    found = slides_along_itself(sweeps, owners, candidates).tolist()
    expected = []
    for window, scene in enumerate(scenes):
        for component, motions in zip(scene.components, scene.candidates.tolist()):
            members = [(m, r, c) for m, pixels in component.items() for r, c in pixels]
            expected.append(oracle.slides_along_itself(for_oracle(sweeps, window), members, motions))
    assert found == expected
    return found


@pytest.mark.parametrize("size", [0.1, 0.15])
def test_answers_equal_the_oracle_in_a_batch_and_alone(size):
    rng = np.random.default_rng(int(100 * size))
    slid = stayed = 0
    for _ in range(4):
        scenes = [random_scene(rng, num_sweeps) for num_sweeps in (2, 4, 3)]
        together = answers(scenes, size)
        assert [answer for scene in scenes for answer in answers([scene], size)] == together
        slid, stayed = slid + sum(map(sum, together)), stayed + sum(not one for row in together for one in row)
    assert slid > 10 and stayed > 100


def rail(start: int, stop: int, row: int = 30) -> Pixels:
    return {(row, c) for c in range(start, stop)}


def slides(component: Dict[int, Pixels], motion, num_sweeps: int = 2, others=None, size: float = 0.1) -> bool:
    scene = Scene([component], others or {}, num_sweeps, np.array([[motion]], dtype=np.float64))
    return answers([scene], size)[0][0]


def test_a_rail_that_stays_slides_and_one_that_leaves_does_not():
    assert slides({0: rail(10, 60), 1: rail(10, 60)}, (0, 12))
    assert slides({0: rail(10, 60), 1: rail(10, 60)}, (0, -12))
    assert not slides({0: rail(30, 80), 1: rail(10, 60)}, (0, 20))
    assert not slides({0: rail(10, 60), 1: rail(10, 60)}, (0, 0))
    assert not slides({0: rail(10, 60), 1: rail(10, 60)}, (12, 0))


def test_a_rail_that_comes_into_sight_or_leaves_it_at_one_end_slides():
    assert slides({0: rail(10, 80), 1: rail(10, 60)}, (0, 12))
    assert slides({0: rail(10, 60), 1: rail(10, 80)}, (0, 12))
    assert not slides({0: rail(10, 60)}, (0, 12))


def test_what_stands_there_need_not_belong_to_the_component():
    assert slides({0: rail(30, 80), 1: rail(10, 60)}, (0, 20), others={0: rail(2, 30), 1: rail(60, 82)})


def test_the_share_that_must_be_covered():
    # A cell has four pixels. One way in time, 7 of 59 looks find nothing in theirs or beside it, then 7 of 58.
    assert slides({0: rail(0, 59), 1: rail(12, 71)}, (0, 13))
    assert not slides({0: rail(0, 58), 1: rail(13, 71)}, (0, 13))
