"""The aperture problem: lines and their limits by hand; trams and walls; the oracle's answers on long things."""

from __future__ import annotations

from typing import Set, Tuple

import numpy as np
import torch
from moving_scenes import for_oracle, from_images
from oracle import aperture as oracle

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.verified.aperture import both_ends_move, slides_along_itself
from cflow_torch.verified.paired_test import count_wins

Pixels = Set[Tuple[int, int]]


def rail(start: int, stop: int, row: int = 30) -> Pixels:
    return {(row, c) for c in range(start, stop)}


def slides(component: dict[int, Pixels], motion, others=None, slices: int = 1) -> bool:
    """Pixels of a component by sweep, t+1 and t; its motion from t to t+1; pixels of others; their slices."""
    image = np.zeros((1, 2, 61, 83), dtype=np.uint8)
    for drawn, value in ((others or {}, 1), (component, 2)):
        for m, pixels in drawn.items():
            for r, c in pixels:
                image[0, m, r, c] = value
    sweeps = from_images(np.minimum(image, 1) * slices, 0.1)
    own = torch.from_numpy(image.ravel())[sweeps.pixels.index] == 2
    members = sweeps.pixels.take(own.nonzero()[:, 0])
    given = sweeps, members, torch.zeros_like(members.row), torch.tensor([[motion]], dtype=torch.float64)
    return bool(slides_along_itself(*given, count_wins(*given).is_covered))


def test_a_rail_covered_in_place_slides_and_one_that_leaves_does_not():
    assert slides({0: rail(10, 60), 1: rail(10, 60)}, (0, 12))
    assert slides({0: rail(10, 60), 1: rail(10, 60)}, (0, -12))
    assert not slides({0: rail(30, 80), 1: rail(10, 60)}, (0, 20))
    assert not slides({0: rail(10, 60), 1: rail(10, 60)}, (0, 0))
    assert not slides({0: rail(10, 60), 1: rail(10, 60)}, (12, 0))


def test_a_long_rail_slides_even_if_each_sweep_samples_other_pixels():
    for end, slices, expected in ((82, 1, True), (82, 2, True), (82, 3, False), (60, 1, False)):
        sampled = {m: {(30, c) for c in range(2 * m, end, 4)} for m in (0, 1)}
        assert slides(sampled, (0, 14), slices=slices) == expected


def test_a_rail_slides_if_one_end_enters_or_leaves_the_view():
    assert slides({0: rail(10, 80), 1: rail(10, 60)}, (0, 12))
    assert slides({0: rail(10, 60), 1: rail(10, 80)}, (0, 12))
    assert not slides({0: rail(10, 60)}, (0, 12))


def test_pixels_of_other_components_cover_a_line_as_well():
    assert slides({0: rail(30, 80), 1: rail(10, 60)}, (0, 20), others={0: rail(2, 30), 1: rail(60, 82)})


def test_a_diagonal_slides_along_itself_and_a_square_does_not_slide():
    diagonal, square = {(r, r + 9) for r in range(5, 55)}, {(r, c) for r in range(9, 40) for c in range(9, 40)}
    assert slides({0: diagonal, 1: diagonal}, (9, 9)) and not slides({0: diagonal, 1: diagonal}, (9, -9))
    flat = {(r, 2 * r) for r in range(5, 40)}  # at 27 degrees, the motions at 36 and 12
    assert slides({0: flat, 1: flat}, (7.6, 10.5)) and not slides({0: flat, 1: flat}, (2.5, 12))
    assert not any(slides({0: square, 1: square}, motion) for motion in ((0, 12), (12, 0), (9, 9)))


def test_a_line_slides_only_if_65_per_cent_are_covered():
    # 41 of 60 pixels are in both sweeps, then 32.
    assert slides({0: rail(0, 60), 1: rail(19, 79)}, (0, 13))
    assert not slides({0: rail(0, 60), 1: rail(28, 83)}, (0, 13))


def test_the_limits_of_a_line_and_of_a_motion_along_it():
    # Standard deviations of 0.29 and 0.32 m across, of 0.98 and 1.04 m along; sines of 0.196 and 0.212; 1.2 and 1.1 m.
    for rows, end, motion, expected in (
        *((10, 60, (0, 12), True), (11, 60, (0, 12), False), (1, 44, (0, 12), False), (1, 46, (0, 12), True)),
        *((1, 60, (2.4, 12), True), (1, 60, (2.6, 12), False), (1, 60, (0, 11), False)),
    ):
        band = {(r, c) for r in range(20, 20 + rows) for c in range(10, end)}
        assert slides({0: band, 1: band}, motion) == expected


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
            alone = for_oracle(sweeps, window)
            members = np.flatnonzero(number_of[window][tuple(alone.pixels.T)] == number)
            assert answer == (bool(is_long[number]) and oracle.both_ends_move(alone, members))
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


def test_a_wall_whose_ends_move_differently_is_static():
    for low, high in ((0.0, 0.0), (SPEED, 0.0), (0.0, SPEED), (SPEED, -SPEED), (SPEED, 0.5 * SPEED)):
        assert mean_flow(low, high) == 0.0


def test_a_noise_barrier_whose_visible_ends_move_is_static():
    assert mean_flow(SPEED, SPEED, length=65.0) == 0.0
    assert mean_flow(SPEED, SPEED, length=55.0) > 0.5 * SPEED


def test_a_rail_whose_visible_ends_move_is_static():
    assert mean_flow(SPEED, SPEED, LOW) == 0.0
