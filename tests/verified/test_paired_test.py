"""The paired test equals the oracle: counts, evidence, choice; the aperture problem: lines by hand, trams, walls."""

from __future__ import annotations

from typing import Set, Tuple

import numpy as np
import pytest
import torch
from moving_scenes import for_oracle, from_images
from oracle import aperture
from oracle import paired_test as oracle

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.ops.groups import Groups
from cflow_torch.verified import comparisons
from cflow_torch.verified import paired_test as fast
from cflow_torch.verified.aperture import are_covered, both_ends_move, slides_along_itself
from cflow_torch.verified.comparisons import count_in_place
from cflow_torch.verified.component_tree import NodeKind, Tree


def random_images(rng: np.random.Generator, shape: tuple) -> np.ndarray:
    """Clumps of pixels that are alike in all sweeps."""
    base = (rng.integers(1, 16, shape[:1] + shape[2:]) * (rng.random(shape[:1] + shape[2:]) < 0.3)).astype(np.uint8)
    return np.where(rng.random(shape) < 0.6, base[:, None], 0).astype(np.uint8)


@pytest.mark.parametrize("at_once", [1 << 18, 700])
def test_counts_equal_the_oracle_up_to_the_border(at_once, monkeypatch):
    monkeypatch.setattr(comparisons, "_AT_ONCE_CPU", at_once)
    far = num_covered = 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        images = random_images(rng, (2, 4, 9, 12))
        images[1, 3] = 0
        elapsed = np.array([[0, 1, 2.1, -1], [0, 1, 2, 0]])  # a sweep after t+1; a window that lacks a sweep
        sweeps = from_images(images, 0.25, elapsed)
        component = torch.from_numpy(rng.integers(0, 3, sweeps.num_pixels)) + 3 * sweeps.pixels.window
        kept = (torch.arange(sweeps.num_pixels) % 7 > 0).nonzero()[:, 0]
        candidates = torch.from_numpy(np.where(rng.random((6, 5, 1)) < 0.7, rng.normal(0, 1.5, (6, 5, 2)), 0.0))
        wins = fast.count_wins(sweeps, sweeps.pixels[kept], Groups(component[kept], 6), candidates)
        given = (sweeps, sweeps.pixels[kept], Groups(component[kept], 6))
        in_place = count_in_place(*given)
        newest = kept[sweeps.pixels.step[kept] == 0]
        covered = are_covered(sweeps, sweeps.pixels[newest], Groups(component[newest], 6))
        component[::7] = 6
        for number in range(6):
            window = for_oracle(sweeps, number // 3)
            members = np.flatnonzero(component[sweeps.pixels.window == number // 3] == number)
            motions = candidates[number].numpy()
            for is_near, counts in ((False, wins.exact), (True, wins.near)):
                expected = [oracle.count_wins(window, members, each, is_near).sum(1) for each in motions]
                assert np.array_equal(torch.stack((counts.won[number], counts.lost[number]), 1), expected)
            expected = oracle.found_in_place(window, members, window.image).sum(0)
            assert [in_place.found[number], in_place.compared[number]] == expected.tolist()
            assert covered[number] == aperture.is_covered(window, members)
            num_covered += int(covered[number])
            far += int((candidates[number].abs().amax(1) > 1.5).sum())
    assert far > 20 and 0 < num_covered < 24


def won_by_older(sweeps, motion: torch.Tensor) -> list[list[int]]:
    """Slices of the older sweep that a motion wins."""
    older = sweeps.pixels[(sweeps.pixels.step == 1).nonzero()[:, 0]]
    return fast.count_wins(sweeps, older, Groups(torch.zeros_like(older.step), 1), motion).exact.won.tolist()


def test_a_far_motion_must_leave_the_neighbourhood_as_well():
    images = np.zeros((1, 2, 5, 12), dtype=np.uint8)
    images[0, 1, 2, 2] = images[0, 0, 2, 6] = images[0, 0, 1, 3] = 1  # a pixel, where it went, one beside its old place
    sweeps = from_images(images)
    motion = torch.tensor([[[0.0, 4.0]]], dtype=torch.float64)
    assert won_by_older(sweeps, motion) == [[0]]
    images[0, 0, 1, 3] = 2  # another slice
    assert won_by_older(from_images(images), motion) == [[1]]


@pytest.mark.parametrize("z", [0.0, 1.5])
def test_evidence_equals_the_oracle(z):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(range(40), range(40))).reshape(2, -1)
    counts = np.concatenate([grid, rng.integers(0, 2**31, (2, 500))], 1)
    found = fast.Counts(*torch.from_numpy(counts)).evidence(z)
    assert found.dtype == torch.int64
    assert found.tolist() == [oracle.evidence_of(won, lost, z) for won, lost in counts.T.tolist()]


def test_the_first_candidate_with_most_evidence_is_chosen():
    evidence = torch.tensor([[2**36 - 2, 2**36 - 1, 2**36 - 1], [1, 0, 2**36 - 1], [0, 0, 0]])
    motion, most = fast.best_motion(evidence, torch.arange(18, dtype=torch.float64).view(3, 3, 2))
    assert motion.tolist() == [[2.0, 3.0], [10.0, 11.0], [0.0, 0.0]] and most.tolist() == [2**36 - 1] * 2 + [0]


@pytest.mark.parametrize(
    "level, num_pixels, moves", [(0, 1, False), (0, 2, True), (NodeKind.CHANGED, 4, False), (NodeKind.CHANGED, 5, True)]
)
def test_nodes_of_changed_pixels_need_twice_as_many_standard_deviations(level, num_pixels, moves):
    """Lone pixels that move win two slices each: 4 > 1.5 * 2 and 10 > 3 * 3.2, but 8 < 3 * 2.8."""
    images = np.zeros((1, 2, 40, 12), dtype=np.uint8)
    images[0, 1, 2 : 4 * num_pixels : 4, 2] = images[0, 0, 2 : 4 * num_pixels : 4, 7] = 1
    sweeps, zero = from_images(images), torch.zeros(1, dtype=torch.int64)
    every = torch.arange(sweeps.num_pixels)
    one = Groups(torch.zeros_like(every), 1)
    tree = Tree(every, one, Groups(zero + 1, 1), zero + level, zero, torch.zeros(1, 2), 2)
    motion, _ = fast.verify(sweeps, tree, torch.tensor([[[0.0, 5.0]]], dtype=torch.float64), 1.5)
    assert motion.tolist() == [[0.0, 5.0 * moves]]


@pytest.mark.parametrize("of_parent, moves", [(True, False), (False, True)])
def test_a_part_of_a_rail_does_not_move_as_the_rail_seems_to(of_parent, moves):
    """Beams hit every eighth pixel of a rail. A third of it is too short for a rail."""
    images = np.zeros((1, 2, 8, 100), dtype=np.uint8)
    images[0, 1, 2, 2:90:8] = images[0, 0, 2, 7:95:8] = 1
    sweeps = from_images(images)
    every = torch.arange(sweeps.num_pixels)
    part = every[sweeps.pixels.row_col[1] < 28]
    members = Groups(torch.cat((torch.zeros_like(every), torch.ones_like(part))), 2)
    zero = torch.zeros(2, dtype=torch.int64)
    tree = Tree(
        torch.cat((every, part)), members, Groups(torch.tensor([2, 0]), 2), zero, zero, torch.zeros(2, 2), num_levels=2
    )
    motions = torch.zeros(2, 2, 2, dtype=torch.float64)
    motions[0, 0, 1] = motions[1, int(of_parent), 1] = 5.0
    motion, _ = fast.verify(sweeps, tree, motions, 1.5)
    assert motion.tolist() == [[0.0, 0.0], [0.0, 5.0 * moves]]


Pixels = Set[Tuple[int, int]]


def values_at(image: np.ndarray, sweeps) -> torch.Tensor:
    """Values of images (B, S, H, W) at the occupied pixels."""
    pixels = sweeps.pixels
    return torch.from_numpy(image)[(pixels.window, pixels.step, *pixels.row_col)]


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
    own = values_at(image, sweeps) == 2
    members = sweeps.pixels[own.nonzero()[:, 0]]
    one = Groups(torch.zeros_like(members.step), 1)
    motions = torch.tensor([[motion]], dtype=torch.float64)
    return bool(slides_along_itself(sweeps, members, one, motions))


def test_a_rail_covered_in_place_slides_and_one_that_leaves_does_not():
    assert slides({0: rail(10, 60), 1: rail(10, 60)}, (0, 12))
    assert slides({0: rail(10, 60), 1: rail(10, 60)}, (0, -12))
    assert not slides({0: rail(30, 80), 1: rail(10, 60)}, (0, 20))
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
    # Standard deviations of 0.29 and 0.32 m across, of 0.98 and 1.04 m along; sines of 0.196 and 0.212.
    for rows, end, motion, expected in (
        *((10, 60, (0, 12), True), (11, 60, (0, 12), False), (1, 44, (0, 12), False), (1, 46, (0, 12), True)),
        *((1, 60, (2.4, 12), True), (1, 60, (2.6, 12), False)),
    ):
        band = {(r, c) for r in range(20, 20 + rows) for c in range(10, end)}
        assert slides({0: band, 1: band}, motion) == expected


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
        sweeps = from_images(image)
        roots = values_at(number_of, sweeps)
        found = both_ends_move(sweeps, sweeps.pixels, Groups(roots, 9))
        for number, answer in enumerate(found.tolist()):
            window = int(sweeps.pixels.window[roots == number][0])
            alone = for_oracle(sweeps, window)
            members = np.flatnonzero(number_of[window][tuple(alone.pixels.T)] == number)
            assert answer == aperture.both_ends_move(alone, members)
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


def test_a_bus_that_shows_only_its_side_moves():
    assert abs(mean_flow(SPEED, SPEED, length=12.0) - SPEED) < 0.05
    assert abs(mean_flow(-0.5, -0.5, length=12.0) + 0.5) < 0.05


def test_a_wall_whose_ends_move_differently_is_static():
    for low, high in ((0.0, 0.0), (SPEED, 0.0), (0.0, SPEED), (SPEED, -SPEED), (SPEED, 0.5 * SPEED)):
        assert mean_flow(low, high) == 0.0
        assert mean_flow(low, high, length=15.0) == 0.0


def test_a_noise_barrier_whose_visible_ends_move_is_static():
    assert mean_flow(SPEED, SPEED, length=65.0) == 0.0
    assert mean_flow(SPEED, SPEED, length=55.0) > 0.5 * SPEED


def test_a_rail_whose_visible_ends_move_is_static():
    assert mean_flow(SPEED, SPEED, LOW) == 0.0
