"""Settings and windows drawn from extremes: the bits of the reference, or the one error; never anything else."""

from __future__ import annotations

import math
from typing import Any, Dict, Tuple

import numpy as np
import pytest
import torch
from oracle import reference_flow
from preset_windows import PRESETS
from scenes import assert_same, has_kornia_labelling, pose

from cflow_torch import CFlowError, Config, Sweep, Window, make_config, make_model

CHOICES: Dict[str, Tuple[Any, ...]] = {
    "max_extent": (1e-6, 5.0, 1e9, math.inf),
    "max_speed": (None, 1e-6, 20.0, 1e12),
    "sweep_interval": (1e-6, 0.1, 1e6),
    "use_timestamps": (True, False),
    "connectivity": (4, 8),
    "slice_height": (1e-6, 0.5, 1e6),
    "gate_radius": (1e-6, 2.0, 1e6),
    "patch_size": (1, 11, 51),
    "ratio_threshold": (1, 1.02, 2),
    "correlation": ("fft", "conv"),
    "labeling": ("sparse", "kornia") if has_kornia_labelling() else ("sparse",),
    "max_memory": (None, 1),
}


def one_of(rng: np.random.Generator, *values: Any) -> Any:
    return values[int(rng.integers(len(values)))]


def draw_config(rng: np.random.Generator) -> Config:
    """Pixels from a micrometre to a thousand kilometres, regions as far away as float64 holds them, or further."""
    preset = one_of(rng, *PRESETS)
    size = one_of(rng, 1e-6, 1e-3, 0.1, 0.25, 0.25, 1.0, 37.0, 1e4, 1e6)
    half, off = size * int(rng.integers(2, 40)) / 2, one_of(rng, 0.0, 0.0, 0.0, 1e3, -1e7, 1e10, 1e15)
    height = one_of(rng, math.inf, 1.0, 1e-3, 1e7)
    settings = {name: one_of(rng, *values) for name, values in CHOICES.items() if rng.random() < 0.4}
    settings["pixel_sizes"] = (4 * size, 2 * size, size) if preset == "default" and rng.random() < 0.7 else (size,)
    settings["point_cloud_range"] = (off - half, off - half, -height, off + half, off + half, height)
    if preset != "keypoints":
        settings["num_history"] = int(rng.integers(0, 3))
    return make_config(preset, **settings)


def draw_cloud(rng: np.random.Generator, config: Config) -> np.ndarray:
    """Up to 60 points in the region and beside it, one of them sometimes no place at all."""
    x0, y0, _, x1, _, _ = config.point_cloud_range
    spread = 0.6 * (x1 - x0)
    points = rng.uniform(-spread, spread, (int(rng.integers(0, 60)), 3)) * [1, 1, one_of(rng, 0, 1, 1e3, 1e9)]
    points += [(x0 + x1) / 2, y0 + (x1 - x0) / 2, one_of(rng, 0, 0, 1e7, -1e16)]
    if len(points) and rng.random() < 0.3:
        points[int(rng.integers(len(points)))] = one_of(rng, np.nan, np.inf, 1e308, -1e300)
    return points.astype(one_of(rng, np.float64, np.float64, np.float64, np.float32, np.float16))


def draw_window(rng: np.random.Generator, config: Config) -> Window:
    """Sweeps that mostly are one cloud, moved by whole pixels and fractions."""
    base, size, sweeps, age = draw_cloud(rng, config), config.pixel_sizes[-1], [], 0
    has_pose, has_time = rng.random() < 0.4, rng.random() < 0.5
    for step in range(2 + config.num_history):
        way = np.array([step * size * one_of(rng, 0, 1, 2.5), step * size * one_of(rng, 0, -1), 0])
        points = base + way.astype(base.dtype) if rng.random() < 0.8 else draw_cloud(rng, config)
        is_ground = rng.random(len(points)) < one_of(rng, 0.0, 0.2, 0.9) if rng.random() < 0.5 else None
        T_world_ego = pose(size * step * one_of(rng, 0, 1), 0, one_of(rng, 0, 0, 0.01))
        sweeps.append(Sweep(points, is_ground, T_world_ego if has_pose else None, 10**18 - age if has_time else None))
        age += one_of(rng, 1, 10**8, 10**8, 10**12)
    return Window(sweeps[1], sweeps[0], tuple(sweeps[2:]))


def count_outcomes(seeds: range) -> Dict[str, int]:
    counts = {"refused": 0, "still": 0, "moved": 0}
    for seed in seeds:
        rng = np.random.default_rng(seed)
        try:
            config = draw_config(rng)
            with np.errstate(over="ignore", invalid="ignore"):
                window = draw_window(rng, config)
            (result,) = make_model(config, "cpu")([window])
        except CFlowError:
            counts["refused"] += 1
            continue
        assert_same(result, reference_flow(window, config))
        for name, value in vars(result).items():
            assert value is None or torch.isfinite(value.double()).all(), (seed, name)
        counts["moved" if result.residual_flow.any() else "still"] += 1
    return counts


def test_extremes_equal_the_reference_or_are_refused() -> None:
    assert min(count_outcomes(range(120)).values()) > 5


@pytest.mark.slow
def test_many_extremes_equal_the_reference_or_are_refused() -> None:
    counts = count_outcomes(range(1000, 4000))
    print(counts)
    assert min(counts.values()) > 150
