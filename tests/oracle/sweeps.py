"""Oracle of the input: clouds in the frame of t+1, without repeated sweeps, with elapsed times."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.config import Config
from cflow_torch.types import Sweep, Window, as_numpy


class Cloud(NamedTuple):
    """One sweep after ego motion compensation.

    Attributes:
        points: (N, 3) float64, metres, frame of t+1; NaN for a point that was not finite.
        is_active: (N,) bool, finite, neither ground nor of the vehicle itself.
        intervals: k, sweep intervals to t+1: 1 for t, 2 for t-1, ..., or by time stamps; 0 for t+1 itself.
        seconds: `intervals` in seconds.
        origin: (x, y, z), metres, frame of t+1: origin of the ego frame of the sweep.
    """

    points: np.ndarray
    is_active: np.ndarray
    intervals: float
    seconds: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


class PointMotion(NamedTuple):
    """The result of a method; rows in the order of the points.

    Attributes:
        flow: of each sweep m <= t, nearest first, (N, 3) float64, metres per sweep interval; 0 without a cluster.
        cluster_id: of sweep t, (N,) int64, -1 without a cluster.
        score: of sweep t, (N,) float64, NCC at the peak of the newest sweep; 0 without a cluster.
        confidence: of sweep t, (N,) float64, for active points; None = the method does not estimate it.
        moving: likewise, the probability that a point moves.
    """

    flow: list[np.ndarray]
    cluster_id: np.ndarray
    score: np.ndarray
    confidence: np.ndarray | None = None
    moving: np.ndarray | None = None


def compensate(window: Window, config: Config) -> tuple[list[Cloud], Cloud]:
    """Eq. def_scene_flow: every sweep in the frame of t+1, by inv(pose1) @ pose.

    Returns:
        Sweeps m = t, t-1, ..., nearest first, at most `config.num_history` before t; and sweep t+1.

    Convention:
        A sweep that repeats an earlier one of this list is dropped (same points, same pose). The others keep their
        times. Without poses the points are already in the frame of t+1. Times are from the time stamps if all sweeps
        have one, else from the positions in the window.
    """
    sweeps = [window.pc0, *window.pch[: config.num_history]]
    stamps = [sweep.timestamp_ns for sweep in (window.pc1, *sweeps)]
    clouds: list[Cloud] = []
    for m, sweep in enumerate(sweeps):
        if any(_is_repeat(sweep, other) for other in sweeps[:m]):
            continue
        intervals, seconds = m + 1.0, (m + 1) * config.sweep_interval
        if None not in stamps:
            gap, first_gap = stamps[0] - stamps[m + 1], stamps[0] - stamps[1]  # type: ignore[operator]
            intervals, seconds = gap / first_gap, gap / 1e9
        moved, is_active = _in_frame_of(window.pc1, sweep), _is_active(sweep, config)
        clouds.append(Cloud(moved, is_active, intervals, seconds, _origin(window.pc1, sweep)))
    return clouds, Cloud(xyz(window.pc1), _is_active(window.pc1, config), 0.0, 0.0)


def xyz(sweep: Sweep) -> np.ndarray:
    """(N, 3) float64, metres: x, y, z of the points of a sweep, in its own frame."""
    return as_numpy(sweep.points, np.float64)[:, :3]


def ground_points(sweep: Sweep, cloud: Cloud) -> np.ndarray:
    """(N, 3) float64, metres, frame of t+1: the ground of a sweep; empty if it is unknown."""
    if sweep.is_ground is None:
        return np.zeros((0, 3))
    return cloud.points[as_numpy(sweep.is_ground, bool) & np.isfinite(cloud.points).all(axis=1)]


def _in_frame_of(sweep1: Sweep, sweep: Sweep) -> np.ndarray:
    points = xyz(sweep)
    finite = np.isfinite(points).all(axis=1)
    moved = np.full(points.shape, np.nan)
    if sweep.pose is None or sweep1.pose is None:
        moved[finite] = points[finite]
        return moved
    T_ego1_ego = np.linalg.inv(as_numpy(sweep1.pose, np.float64)) @ as_numpy(sweep.pose, np.float64)
    x, y, z = points[finite].T
    for axis, (r_x, r_y, r_z, translation) in enumerate(T_ego1_ego[:3]):
        moved[finite, axis] = ((r_x * x + r_y * y) + r_z * z) + translation
    return moved


def _origin(sweep1: Sweep, sweep: Sweep) -> tuple[float, float, float]:
    if sweep.pose is None or sweep1.pose is None:
        return 0.0, 0.0, 0.0
    x, y, z = (np.linalg.inv(as_numpy(sweep1.pose, np.float64)) @ as_numpy(sweep.pose, np.float64))[:3, 3].tolist()
    return x, y, z


def _is_repeat(sweep: Sweep, newer: Sweep) -> bool:
    if (sweep.pose is None) != (newer.pose is None):
        return False
    same_pose = sweep.pose is None or np.array_equal(as_numpy(sweep.pose), as_numpy(newer.pose))
    return same_pose and np.array_equal(as_numpy(sweep.points), as_numpy(newer.points), equal_nan=True)


def _is_active(sweep: Sweep, config: Config) -> np.ndarray:
    points = xyz(sweep)
    is_active = np.isfinite(points).all(axis=1)
    if config.ego_box is not None:
        x0, y0, x1, y1 = config.ego_box
        x, y = points[:, 0], points[:, 1]
        is_active &= ~((x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1))
    return is_active if sweep.is_ground is None else is_active & ~as_numpy(sweep.is_ground, bool)
