"""Sweeps of a vehicle that turns, and the flow that a harness must get."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scenes import RANGE, scene

from cflow_torch import CorrelationFlow, Sweep, Window, make_config

SETTINGS: dict[str, Any] = {"preset": "paper", "pixel_sizes": (0.25,), "point_cloud_range": RANGE, "max_extent": 5.0}


def drive(num_sweeps: int, seed: int = 7, rotation: float = 0.2) -> list[Sweep]:
    """Sweeps of a vehicle that turns (rad per sweep), oldest first."""
    made = scene(seed, num_history=num_sweeps - 2, num_objects=6, rotation=rotation)
    sweeps = [*made.pch[::-1], made.pc0, made.pc1]
    return [replace(sweep, timestamp_ns=10**8 * k) for k, sweep in enumerate(sweeps)]


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
