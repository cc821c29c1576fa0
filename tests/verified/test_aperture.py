"""The aperture problem: the oracle's answers on random lines and long things, known ones by hand; trams and walls."""

from __future__ import annotations

from typing import NamedTuple, Sequence, Set, Tuple

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle, from_images
from oracle import aperture as oracle

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.verified.aperture import both_ends_move, slides_along_itself
from cflow_torch.verified.paired_test import count_wins

HEIGHT, WIDTH = 61, 83
Pixels = Set[Tuple[int, int]]


class Scene(NamedTuple):
    """A window: per component its pixels by sweep, other pixels by sweep, number of sweeps, candidates (A, C, 2)."""

    components: list[dict[int, Pixels]]
    others: dict[int, Pixels]
    num_sweeps: int
    candidates: np.ndarray


def line(rng: np.random.Generator, start, direction: float, length: float, noise: float) -> Pixels:
    count = rng.integers(1, 200)
    along, across = rng.uniform(0, length, count), rng.normal(0, noise, count)
    y = start[0] + along * np.sin(direction) + across * np.cos(direction)
    x = start[1] + along * np.cos(direction) - across * np.sin(direction)
    inside = (y >= 0) & (y < HEIGHT) & (x >= 0) & (x < WIDTH)
    return {(int(r), int(c)) for r, c in zip(y[inside], x[inside])}


def random_scene(rng: np.random.Generator, num_sweeps: int) -> Scene:
    """Lines that stand, lines that move, lines that are longer than seen before; some thick, some short."""
    taken: dict[int, Pixels] = {m: set() for m in range(num_sweeps)}
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


def answers(scenes: Sequence[Scene], size: float = 0.1) -> list[list[bool]]:
    """Of a batch; they are those of the oracle."""
    num_steps = max(scene.num_sweeps for scene in scenes)
    image = np.zeros((len(scenes), num_steps, HEIGHT, WIDTH), dtype=np.uint8)
    number_of = np.full(image.shape, sum(len(scene.components) for scene in scenes))
    elapsed, number = np.zeros((len(scenes), num_steps)), 0
    for window, scene in enumerate(scenes):
        elapsed[window, : scene.num_sweeps] = np.arange(scene.num_sweeps)
        for m, pixels in scene.others.items():
            for r, c in pixels:
                image[window, m, r, c] = 1
        for component in scene.components:
            for m, pixels in component.items():
                for r, c in pixels:
                    image[window, m, r, c], number_of[window, m, r, c] = 1 + (r + c) % 15, number
            number += 1
    sweeps = from_images(image, size, elapsed)
    owners = torch.from_numpy(number_of.ravel())[sweeps.pixels.index]
    candidates = torch.from_numpy(np.concatenate([scene.candidates for scene in scenes]))
    kept = owners < number
    members, component = sweeps.pixels.take(kept.nonzero()[:, 0]), owners[kept]
    is_covered = count_wins(sweeps, members, component, candidates).is_covered
    found = slides_along_itself(sweeps, members, component, candidates, is_covered).tolist()
    expected = []
    for window, scene in enumerate(scenes):
        for component, motions in zip(scene.components, scene.candidates.tolist()):
            members = [(m, r, c) for m, pixels in component.items() for r, c in pixels]
            expected.append([oracle.slides_along_itself(for_oracle(sweeps, window), members, m) for m in motions])
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


def slides(component: dict[int, Pixels], motion, num_sweeps: int = 2, others=None, size: float = 0.1) -> bool:
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
    # 41 of 60 pixels are in both sweeps, then 32.
    assert slides({0: rail(0, 60), 1: rail(19, 79)}, (0, 13))
    assert not slides({0: rail(0, 60), 1: rail(28, 83)}, (0, 13))


# ---------------------------------------------------------------------------------------------------- long vehicles


def long_things(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """(3, 4, H, W) slices and owners of nine long things, some of which move, and some of which end anywhere."""
    rng, (height, width) = np.random.default_rng(seed), (90, 110)
    image, number_of = np.zeros((3, 4, height, width), dtype=np.uint8), np.full((3, 4, height, width), 9)
    for number in range(9):
        direction, length = rng.choice([0.0, 0.3, -0.4]), rng.uniform(10, 60)
        start, speed = rng.uniform((5, 15), (25, 30)) + [30 * (number // 3), 0], rng.choice([0, 3, 5])
        slices = rng.choice([1, 3, 5, 6, 7, 15], 200, p=[0.1, 0.3, 0.2, 0.2, 0.1, 0.1])
        for m in range(4 if rng.random() < 0.9 else 3):
            along = rng.uniform(0, length, 200) - m * speed + rng.choice([0, rng.normal(0, 2)])
            r = (start[0] + along * np.sin(direction)).astype(int).clip(0, height - 1)
            c = (start[1] + along * np.cos(direction)).astype(int).clip(0, width - 1)
            image[number % 3, m, r, c], number_of[number % 3, m, r, c] = slices, number
    return image, number_of


def test_ends_equal_the_oracle():
    moved = stayed = 0
    for seed in range(12):
        image, number_of = long_things(seed)
        sweeps, is_long = from_images(image), np.random.default_rng(seed).random(9) < 0.9
        roots = torch.from_numpy(number_of.ravel())[sweeps.pixels.index]
        # Two levels: things by themselves, and all in one.
        found = both_ends_move(sweeps, torch.stack((torch.full_like(roots, 9), roots)), torch.tensor([*is_long, False]))
        assert not found[9]
        for number, answer in enumerate(found[:9].tolist()):
            window = int(sweeps.pixels.window[roots == number][0])
            members = [tuple(at) for at in np.argwhere((number_of[window] == number) & (image[window] > 0)).tolist()]
            assert answer == (bool(is_long[number]) and oracle.both_ends_move(for_oracle(sweeps, window), members))
            moved, stayed = moved + answer, stayed + (not answer)
    assert moved > 10 and stayed > 10


LENGTH, SPEED = 30.0, 0.8
TALL, LOW = (-1.5, 1.5), (-1.4, -1.2)


def side(ends: tuple[float, float], heights: tuple[float, float], seed: int) -> Sweep:
    """The side of something long, sampled anew each time."""
    rng = np.random.default_rng(seed)
    x = np.concatenate((ends, rng.uniform(*ends, round(100 * (ends[1] - ends[0])))))
    z = rng.choice(np.arange(heights[0], heights[1] + 0.1, 0.4), len(x))
    return Sweep(np.column_stack((x, 5 + rng.normal(0, 0.02, len(x)), z)).astype(np.float32))


def mean_flow(low_speed: float, high_speed: float, heights=TALL, length: float = LENGTH) -> float:
    """Mean flow along x of what has these speeds at its ends, metres per sweep."""
    ends = [(-length / 2 - low_speed * k, length / 2 - high_speed * k) for k in range(-1, 5)]
    newest, own, *older = (side(end, heights, 50 + k) for k, end in enumerate(ends))
    region = (-45.0, -5.0, -np.inf, 45.0, 15.0, np.inf)
    (result,) = VerifiedFlow(make_config("default", point_cloud_range=region))([Window(own, newest, tuple(older))])
    assert not result.residual_flow[:, 1].abs().max() > 0.1
    return float(result.residual_flow[:, 0].mean())


def test_a_tram_moves():
    assert abs(mean_flow(SPEED, SPEED) - SPEED) < 0.05
    assert abs(mean_flow(-SPEED, -SPEED) + SPEED) < 0.05


def test_a_wall_whose_ends_do_not_go_together_is_static():
    for low, high in ((0.0, 0.0), (SPEED, 0.0), (0.0, SPEED), (SPEED, -SPEED), (SPEED, 0.5 * SPEED)):
        assert mean_flow(low, high) == 0.0


def test_a_noise_barrier_that_seems_to_keep_pace_is_static():
    assert mean_flow(SPEED, SPEED, length=65.0) == 0.0
    assert mean_flow(SPEED, SPEED, length=55.0) > 0.5 * SPEED


def test_a_rail_that_seems_to_keep_pace_is_static():
    assert mean_flow(SPEED, SPEED, LOW) == 0.0
