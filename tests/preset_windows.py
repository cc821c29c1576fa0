"""Small windows and settings, to run every preset many times and to compare it with the oracle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Callable

from scenes import RANGE, scene

from cflow_torch import Config, FlowResult, Sweep, Window, make_config

PRESETS = ("default", "offline", "paper", "keypoints")


def small(preset: str, **overrides: Any) -> Config:
    """A preset on 16 m x 14 m with pixels of 0.25 m, and two older sweeps if the method uses history."""
    given: dict[str, Any] = {"pixel_sizes": (0.5, 0.25) if preset in ("default", "offline", "live") else (0.25,)}
    if preset in ("paper", "keypoints"):
        given["max_extent"] = 5.0
    if preset != "keypoints":
        given["num_history"] = 2
    return make_config(preset, **{"point_cloud_range": RANGE, **given, **overrides})


def windows_for(config: Config, number: int = 1) -> list[Window]:
    """Windows in which every preset finds motion. The last of several is a pair."""
    seeds = (12, 11, 3, 8)[:number]
    history = [config.num_history] * max(number - 1, 1) + [0]
    return [scene(s, num_history=h, num_future=config.num_future, num_points=90) for s, h in zip(seeds, history)]


def changed(window: Window, change: Callable[[Sweep], Sweep]) -> Window:
    return window.with_sweeps(map(change, window.sweeps))


def untimed(window: Window) -> Window:
    return changed(window, lambda sweep: replace(sweep, point_times=None))


def num_moving(result: FlowResult) -> int:
    """Number of points with residual flow."""
    return int(result.residual_flow.any(1).sum())
