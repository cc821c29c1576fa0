"""The paired test: counts, evidence and choice equal to the oracle's; ties, borders, missing sweeps."""

from __future__ import annotations

from typing import Tuple

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import for_oracle, from_images
from oracle import paired_test as oracle
from scenes import same_bits

from cflow_torch.verified import paired_test as fast

EVERY = slice(None)


class Scene:
    """Random images of B windows, S sweeps; random components; candidates on and between whole pixels."""

    def __init__(self, seed: int, num_windows: int = 2, num_steps: int = 3) -> None:
        rng = np.random.default_rng(seed)
        shape = (num_windows, num_steps, *rng.integers(3, 18, 2).tolist())
        self.images = (rng.integers(1, 16, shape) * (rng.random(shape) < 0.5)).astype(np.uint8)
        self.elapsed = np.tile(np.arange(num_steps) * rng.choice([1.0, 1.07]), (num_windows, 1))
        if num_steps > 2:  # the first window lacks the oldest sweep
            self.images[0, -1], self.elapsed[0, -1] = 0, 0.0
        self.count = 5
        component = rng.integers(0, self.count + 1, shape)  # the last: none
        own_window = component % num_windows == np.arange(num_windows)[:, None, None, None]
        self.component = np.where(own_window, component, self.count)
        self.candidates = rng.integers(-8, 9, (self.count, 4, 2)) / rng.choice([1.0, 2.0, 3.0])
        self.candidates[:, 1] = rng.normal(0, 2, (self.count, 2))
        self.candidates[0, 2], self.candidates[1, 3] = self.candidates[0, 0], 0.0
        self.tested = rng.random(self.count) < 0.8

    def found(self, windows: slice = EVERY) -> Tuple[torch.Tensor, torch.Tensor]:
        sweeps = from_images(self.images[windows], elapsed=self.elapsed[windows])
        component = torch.from_numpy(self.component[windows].ravel())[sweeps.pixel]
        return fast.count_wins(sweeps, component, *map(torch.from_numpy, (self.candidates, self.tested)))

    def expected(self) -> np.ndarray:
        counts = np.zeros((2, *self.candidates.shape[:2]), dtype=np.int64)
        sweeps = from_images(self.images, elapsed=self.elapsed)
        for window in range(len(self.images)):
            of_window = for_oracle(sweeps, window)
            for i in np.flatnonzero(self.tested).tolist():
                members = [pixel for pixel in of_window.pixels() if self.component[(window, *pixel)] == i]
                for c, motion in enumerate(self.candidates[i].tolist()):
                    counts[:, i, c] += oracle.count_wins(of_window, members, tuple(motion))
        return counts


@pytest.mark.parametrize("num_windows, num_steps", [(1, 2), (2, 3), (3, 5)])
def test_counts_equal_the_oracle(num_windows, num_steps):
    for seed in range(4):
        scene = Scene(seed, num_windows, num_steps)
        won, lost = scene.found()
        expected = scene.expected()
        assert won.dtype == lost.dtype == torch.int64
        assert [won.tolist(), lost.tolist()] == expected.tolist()
        assert expected.max() > 5


def test_batch_equals_loop():
    scene = Scene(4, num_windows=3, num_steps=4)
    alone = [scene.found(slice(window, window + 1)) for window in range(3)]
    for values, parts in zip(scene.found(), zip(*alone)):
        assert same_bits(values, sum(parts))  # a component has pixels in one window only


def test_a_row_by_hand():
    # Sweep t: two pixels with slices 1 and 3; t+1: both two pixels further on, and slice 1 where the first one was.
    images = np.zeros((1, 2, 1, 8), dtype=np.uint8)
    images[0, 1, 0, [1, 2]] = 0b01, 0b11
    images[0, 0, 0, [1, 3, 4]] = 0b01, 0b01, 0b11
    candidates = torch.tensor([[[0.0, 2.0], [0.0, 1.5], [0.0, 1.49], [0.0, 0.0], [5.0, 0.0]]]).double()
    sweeps = from_images(images)
    won, lost = fast.count_wins(sweeps, torch.zeros_like(sweeps.pixel), candidates, torch.tensor([True]))
    # Forwards, by 2: pixel 1 meets slice 1 at 3, which is also at 1, no news; pixel 2 meets two slices at 4, of which
    # slice 1 is beside it, at 1 and 3. Backwards by 2: pixel 1 goes to -1 and loses the slice at 1; pixel 3 meets slice
    # 1 at 1, but has it beside it, at 2; pixel 4 wins two. By 1.5 the same forwards; backwards floor(-1) = -1, so what
    # is beside does not count: pixel 1 loses, 3 and 4 win one and nothing. By 1.49: 1 forwards, where only pixel 2 wins
    # one and 1 loses one; -1 back.
    assert won.tolist() == [[3, 2, 2, 0, 0]]
    assert lost.tolist() == [[1, 1, 2, 0, 2]]


def row(*columns: int) -> np.ndarray:
    """(1, 1, 3, 24) uint8 image, one slice on some columns of the middle row."""
    image = np.zeros((1, 1, 3, 24), dtype=np.uint8)
    image[0, 0, 1, list(columns)] = 1
    return image


def wins_of(images: np.ndarray, dx: float) -> Tuple[int, int]:
    sweeps = from_images(images)
    candidates = torch.tensor([[[0.0, dx]]], dtype=torch.float64)
    won, lost = fast.count_wins(sweeps, torch.zeros_like(sweeps.pixel), candidates, torch.tensor([True]))
    expected = oracle.count_wins(for_oracle(sweeps, 0), for_oracle(sweeps, 0).pixels(), (0.0, dx))
    assert (int(won), int(lost)) == expected
    return expected


def test_what_jitters_by_a_pixel_does_not_win_and_what_leaves_does():
    # A side that stands: every second pixel at t, those between at t+1. All of it meets something three pixels ahead,
    # and nothing where it stands.
    side = np.concatenate((row(*range(5, 18, 2)), row(*range(4, 17, 2))), 1)
    assert wins_of(side, 3.0) == (0, 0)
    # By one pixel or less a pixel beside counts as another place: slow motion is told by nothing else.
    assert wins_of(side, 1.0) == (14, 0)
    # A car leaves by thirteen: nothing is beside its old place at t+1, nor beside its new one at t.
    assert wins_of(np.concatenate((row(2, 4, 6), row(15, 17, 19)), 1), -13.0) == (6, 0)


def test_far_is_two_pixels_of_each_look_in_rows_or_in_columns():
    # By a pixel per interval t and t+1 see each other, both win. Seen from t-1 it is two: what t+1 has beside the old
    # place takes that win away; t+1 has won its look at t-1.
    assert wins_of(np.concatenate((row(8), row(9), row(10)), 1), -1.0) == (4, 0)
    assert wins_of(np.concatenate((row(8, 11), row(9), row(10)), 1), -1.0) == (3, 0)
    # In rows: t does not win by three, since t+1 has something beside its old place; by one it does.
    steep = np.zeros((1, 2, 7, 4), dtype=np.uint8)
    steep[0, 0, [1, 3], 1], steep[0, 1, 4, 1] = 1, 1
    sweeps = from_images(steep)
    motions = torch.tensor([[[-3.0, 0.0], [-1.0, 0.0]]], dtype=torch.float64)
    won, lost = fast.count_wins(sweeps, torch.zeros_like(sweeps.pixel), motions, torch.tensor([True]))
    assert won.tolist() == [[1, 2]] and lost.tolist() == [[0, 0]]


@pytest.mark.parametrize("z", [0.0, 1.5])
def test_evidence_equals_the_oracle(z):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(range(40), range(40))).reshape(2, -1)
    counts = np.concatenate([grid, rng.integers(0, 2**31, (2, 500))], 1)
    found = fast.evidence_of(*torch.from_numpy(counts), z)
    assert found.dtype == torch.int64
    assert found.tolist() == [oracle.evidence_of(won, lost, z) for won, lost in counts.T.tolist()]


@settings(deadline=None, max_examples=40, derandomize=True)
@given(st.integers(1, 6).flatmap(lambda c: st.lists(st.lists(st.integers(0, 3), min_size=c, max_size=c), min_size=1)))
def test_choice_equals_the_oracle(evidence):
    candidates = np.random.default_rng(1).normal(size=(len(evidence), len(evidence[0]), 2))
    motion, most = fast.best_candidate(torch.tensor(evidence), torch.from_numpy(candidates))
    expected = [oracle.best_candidate(row, [tuple(f) for f in fs]) for row, fs in zip(evidence, candidates.tolist())]
    assert [(tuple(f), e) for f, e in zip(motion.tolist(), most.tolist())] == expected


def test_much_evidence_is_told_apart():
    evidence = torch.tensor([[2**36 - 2, 2**36 - 1, 2**36 - 1], [1, 0, 2**36 - 1]])
    motion, most = fast.best_candidate(evidence, torch.arange(12, dtype=torch.float64).view(2, 3, 2))
    assert motion.tolist() == [[2.0, 3.0], [10.0, 11.0]] and most.tolist() == [2**36 - 1] * 2


def test_a_wall_is_still_where_it_stood_and_a_car_is_not():
    # By six pixels: all that is left of the wall, all but its first six columns of the car.
    wall = np.concatenate((row(*range(2, 22)), row(*range(2, 22))), 1)
    car = np.concatenate((row(*range(8, 20)), row(*range(2, 14))), 1)
    for images, stands in ((wall, True), (car, False)):
        sweeps, motion = from_images(images), torch.tensor([[0.0, 6.0]], dtype=torch.float64)
        assert fast.is_found_where_it_stands(sweeps, torch.zeros_like(sweeps.pixel), motion).tolist() == [stands]
        of_loop = for_oracle(sweeps, 0)
        assert oracle.is_found_where_it_stands(of_loop, of_loop.pixels(), (0.0, 6.0)) == stands
    # A motion of three pixels is not asked about.
    sweeps = from_images(wall)
    short = torch.tensor([[0.0, 3.0]], dtype=torch.float64)
    assert fast.is_found_where_it_stands(sweeps, torch.zeros_like(sweeps.pixel), short).tolist() == [False]
