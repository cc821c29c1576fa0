"""Sweeps with a turning vehicle, a wall, a parked and a moving box, and the flow that a harness must get."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scenes import RANGE, box, pose

from cflow_torch import CorrelationFlow, Sweep, Window, make_config

YAW_STEP = 0.1  # rad, 5.7 degrees between two sweeps
SETTINGS: dict[str, Any] = {"preset": "paper", "pixel_sizes": (0.25,), "point_cloud_range": RANGE, "max_extent": 5.0}


def drive(num_sweeps: int, velocity: float = 0.5, yaw_step: float = YAW_STEP, noise: float = 0.02) -> list[Sweep]:
    """Sweeps, oldest first. Numbers of points differ, order is shuffled, a tenth is ground, one row is NaN."""
    rng = np.random.default_rng(7)
    wall = np.stack([np.linspace(-8, 8, 200), np.full(200, 5.0), rng.uniform(0, 2, 200)], 1)
    parked = box(rng, 3.0, 1.6, 1.5, 150) + [-2.0, -4.0, 0.0]
    moving = box(rng, 2.0, 1.0, 1.5, 150) + [1.0, 1.0, 0.0]
    ground = np.stack([rng.uniform(-7, 7, 60), rng.uniform(-6, 6, 60), np.full(60, -0.1)], 1)
    sweeps = []
    for k in range(num_sweeps):
        solid = np.concatenate([wall, parked, moving + [0.6 * velocity * k, 0.8 * velocity * k, 0.0]])
        solid = solid + noise * rng.standard_normal(solid.shape)
        T_world_ego = pose(0.3 * k, 0.05 * k, yaw_step * k)
        points = np.concatenate([solid, ground[: 60 - k]])
        points = ((points - T_world_ego[:3, 3]) @ T_world_ego[:3, :3]).astype(np.float32)
        points[3] = np.nan
        order = rng.permutation(len(points))
        sweeps.append(Sweep(points[order], (np.arange(len(points)) >= len(solid))[order], T_world_ego, 10**8 * k))
    return sweeps


def expected(sweeps: list[Sweep], index: int, num_history: int) -> np.ndarray:
    """(N, 3) float64 residual of sweep `index` by the method itself, rotated by R^T into the axes of t."""
    window = Window(sweeps[index], sweeps[index + 1], tuple(sweeps[max(index - num_history, 0) : index][::-1]))
    settings = {key: value for key, value in SETTINGS.items() if key != "preset"}
    model = CorrelationFlow(make_config("paper", num_history=num_history, **settings))
    residual = model([window])[0].residual_flow.double().numpy()
    T_ego1_ego0 = np.linalg.inv(np.asarray(window.pc1.pose)) @ np.asarray(window.pc0.pose)
    return np.stack([T_ego1_ego0[:3, :3].T @ row for row in residual])


def relative_to(sweeps: list[Sweep], index: int) -> list[np.ndarray]:
    """Poses of the sweeps in the ego frame of one of them."""
    return [np.linalg.inv(np.asarray(sweeps[index].pose)) @ np.asarray(sweep.pose) for sweep in sweeps]


def speeds(flow: Any) -> np.ndarray:
    """(N,) lengths of a flow."""
    return np.linalg.norm(torch.as_tensor(flow).double().numpy(), axis=-1)
