"""Long vehicles: the oracle's answers on random long things; a tram moves, walls and rails do not."""

from __future__ import annotations

from typing import List, Tuple

import numpy as np
import torch
from moving_scenes import for_oracle, from_images
from oracle import long_vehicles as oracle

from cflow_torch import Sweep, VerifiedFlow, Window, make_config
from cflow_torch.verified.long_vehicles import ends_travel

HEIGHT, WIDTH, SIZE = 90, 110, 0.25
LENGTH, SPEED = 30.0, 0.8
TALL, LOW = (-1.5, 1.5), (-1.4, -1.2)


def answers(image: np.ndarray, owner: np.ndarray, is_long: np.ndarray) -> List[bool]:
    """For (B, S, H, W) slices and owners."""
    elapsed = np.tile(np.arange(image.shape[1], dtype=np.float64), (len(image), 1))
    sweeps = from_images(image, SIZE, elapsed)
    component = torch.from_numpy(owner.reshape(-1))[sweeps.pixel]
    found = ends_travel(sweeps, component, torch.from_numpy(is_long)).tolist()
    for number, answer in enumerate(found):
        window = int(sweeps.window[component == number][0])
        members = [(m, r, c) for m, r, c in np.argwhere(owner[window] == number).tolist() if image[window, m, r, c]]
        assert answer == (bool(is_long[number]) and oracle.ends_travel(for_oracle(sweeps, window), members))
    return found


def test_answers_equal_the_oracle():
    travelled = stayed = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        image, owner = np.zeros((3, 4, HEIGHT, WIDTH), dtype=np.uint8), np.full((3, 4, HEIGHT, WIDTH), 9)
        for number in range(9):
            direction, length = rng.choice([0.0, 0.3, -0.4]), rng.uniform(10, 60)
            start, speed = rng.uniform((5, 15), (25, 30)) + [30 * (number // 3), 0], rng.choice([0, 3, 5])
            slices = rng.choice([1, 3, 5, 6, 7, 15], 300, p=[0.1, 0.3, 0.2, 0.2, 0.1, 0.1])
            for m in range(4 if rng.random() < 0.9 else 3):
                along = rng.uniform(0, length, 200) - m * speed + rng.choice([0, rng.normal(0, 2)])
                r = (start[0] + along * np.sin(direction)).astype(int).clip(0, HEIGHT - 1)
                c = (start[1] + along * np.cos(direction)).astype(int).clip(0, WIDTH - 1)
                image[number % 3, m, r, c], owner[number % 3, m, r, c] = slices[:200], number
        owner[image == 0] = 9
        found = answers(image, owner, rng.random(9) < 0.9)
        travelled, stayed = travelled + sum(found), stayed + 9 - sum(found)
    assert travelled > 10 and stayed > 10


def sweep(ends: Tuple[float, float], heights: Tuple[float, float], seed: int) -> Sweep:
    """The side of something long, sampled anew each time."""
    rng = np.random.default_rng(seed)
    x = np.concatenate((ends, rng.uniform(*ends, 3000)))
    z = rng.choice(np.arange(heights[0], heights[1] + 0.1, 0.4), len(x))
    return Sweep(np.column_stack((x, 5 + rng.normal(0, 0.02, len(x)), z)).astype(np.float32))


def mean_flow(low_speed: float, high_speed: float, heights=TALL) -> float:
    """Mean flow along x of what has these speeds at its ends, metres per sweep."""
    ends = [(-15 - low_speed * k, -15 + LENGTH - high_speed * k) for k in range(-1, 5)]
    newest, own, *older = (sweep(end, heights, 50 + k) for k, end in enumerate(ends))
    (result,) = VerifiedFlow(make_config("default"))([Window(own, newest, tuple(older))])
    assert not result.residual_flow[:, 1].abs().max() > 0.1
    return float(result.residual_flow[:, 0].mean())


def test_a_tram_moves():
    assert abs(mean_flow(SPEED, SPEED) - SPEED) < 0.05
    assert abs(mean_flow(-SPEED, -SPEED) + SPEED) < 0.05


def test_a_wall_whose_ends_do_not_go_together_stands():
    for low, high in ((0.0, 0.0), (SPEED, 0.0), (0.0, SPEED), (SPEED, -SPEED), (SPEED, 0.5 * SPEED)):
        assert mean_flow(low, high) == 0.0


def test_a_rail_that_seems_to_keep_pace_stands():
    assert mean_flow(SPEED, SPEED, LOW) == 0.0
