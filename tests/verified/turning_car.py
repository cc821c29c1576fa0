"""A scene for the verified method: a car that turns, a person beside a wall, a post, ground."""

from __future__ import annotations

import numpy as np
from scenes import box, pose

from cflow_torch import Sweep, Window
from cflow_torch.config import VerifiedConfig

REGION = (-8.0, -8.0, -3.0, 8.0, 8.0, 5.0)
MODEL = VerifiedConfig(pixel_sizes=(0.4, 0.2, 0.1), point_cloud_range=REGION, max_speed=40.0, max_object_length=10.0)


def upright_box(centre, size, angle: float, rng: np.random.Generator, num_points: int = 250) -> np.ndarray:
    """Points on the sides of a box, standing 0.2 m above z = -1.7."""
    points = box(rng, *size, 1.5, num_points) @ pose(0, 0, angle)[:3, :3].T
    return points + (*centre, -1.5)


def car_of(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre at t, velocity and turn of the car, per interval."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-2, 2, 2), rng.uniform(-0.8, 0.8, 2), rng.uniform(-0.05, 0.05)


def turning_car(seed: int, num_history: int = 0, share: float = 1.0) -> Window:
    """Every sweep sampled anew, with that share of the points; the sensor stands still."""
    rng, (start, velocity, rotation) = np.random.default_rng((seed, 1)), car_of(seed)
    sweeps = []
    for k in range(1, -num_history - 1, -1):  # t+1 first
        parts = [
            upright_box(start + k * velocity, (4.0, 1.8), 0.3 + k * rotation, rng),
            upright_box((-5.0 + 0.12 * k, -5.4), (0.4, 0.5), 0.0, rng, 60),
            upright_box((-4.0, -6.2), (6.0, 0.3), 0.0, rng),
            upright_box((5.5, 5.5), (0.3, 0.3), 0.0, rng, 40),
            np.concatenate((rng.uniform(-8, 8, (1500, 2)), rng.normal(-1.75, 0.02, (1500, 1))), 1),
            np.concatenate((rng.uniform(-8, 8, (40, 2)), rng.uniform(-1.7, -1.45, (40, 1))), 1),  # left over
        ]
        is_ground = np.zeros(sum(map(len, parts)), dtype=bool)
        is_ground[-1540:-40] = True
        order = rng.permutation(len(is_ground))[: int(share * len(is_ground))]
        sweeps.append(Sweep(np.concatenate(parts)[order].astype(np.float32), is_ground=is_ground[order]))
    return Window(pc0=sweeps[1], pc1=sweeps[0], pch=tuple(sweeps[2:]))
