"""From a window to clouds in the frame of t+1: ego motion compensation, repeated sweeps, elapsed times."""

from __future__ import annotations

from typing import Any, List, NamedTuple, Optional, Tuple

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.types import Sweep, Window


class Cloud(NamedTuple):
    """One sweep after ego motion compensation.

    Attributes:
        points: (N, 3) float64, metres, frame of t+1; NaN for a point that was not finite.
        takes_part: (N,) bool, finite, neither ground nor of the vehicle itself.
        steps: k, elapsed time to t+1 in sweep intervals: 1 for t, 2 for t-1 ...; 0 for t+1 itself.
        elapsed: seconds to t+1.
    """

    points: np.ndarray
    takes_part: np.ndarray
    steps: float
    elapsed: float


class Level(NamedTuple):
    """What one scale finds, one array per sweep m <= t, nearest first; rows in the order of the sweep's points.

    Attributes:
        flow: each (N, 3) float64, metres per sweep interval; 0 for points in no cluster.
        cluster_id: each (N,) int64, -1 for points in no cluster.
        score: each (N,) float64, NCC at the peak of the newest sweep; 0 for points in no cluster.
        confidence: each (N,) float64, of points that take part; None = the method does not say.
    """

    flow: List[np.ndarray]
    cluster_id: List[np.ndarray]
    score: List[np.ndarray]
    confidence: Optional[List[np.ndarray]] = None


def compensate(window: Window, config: Config) -> Tuple[List[Cloud], Cloud]:
    """Eq. def_scene_flow: every sweep in the frame of t+1, by inv(pose1) @ pose.

    Returns:
        Sweeps m = t, t-1, ..., nearest first, at most `config.num_history` before t; and sweep t+1.

    Convention:
        A sweep that repeats a newer one (same points, same pose) is dropped; k of the others still counts places
        in the window. Without poses the points already lie in the frame of t+1. Elapsed times are those of the
        time stamps if all sweeps have one, else steps times `sweep_interval`.
    """
    sweeps = [window.pc0, *window.pch[: config.num_history]]
    has_stamps = all(sweep.timestamp_ns is not None for sweep in [window.pc1, *sweeps])
    clouds: List[Cloud] = []
    for m, sweep in enumerate(sweeps):
        if any(_is_repeat(sweep, newer) for newer in sweeps[:m]):
            continue
        steps, elapsed = float(m + 1), (m + 1) * config.sweep_interval
        if has_stamps:
            elapsed_ns = int(window.pc1.timestamp_ns) - int(sweep.timestamp_ns)  # type: ignore[arg-type]
            first_ns = int(window.pc1.timestamp_ns) - int(window.pc0.timestamp_ns)  # type: ignore[arg-type]
            elapsed = elapsed_ns / 1e9
            if config.use_timestamps:
                steps = elapsed_ns / first_ns
        clouds.append(Cloud(_in_frame_of(window.pc1, sweep), _takes_part(sweep, config), steps, elapsed))
    return clouds, Cloud(xyz(window.pc1), _takes_part(window.pc1, config), 0.0, 0.0)


def _in_frame_of(sweep1: Sweep, sweep: Sweep) -> np.ndarray:
    points = xyz(sweep)
    finite = np.isfinite(points).all(axis=1)
    moved = np.full(points.shape, np.nan)
    if sweep.pose is None:
        moved[finite] = points[finite]
        return moved
    matrix = np.linalg.inv(_matrix(sweep1.pose)) @ _matrix(sweep.pose)  # T_ego1_ego
    x, y, z = points[finite].T
    for axis in range(3):
        rotation, translation = matrix[axis, :3], matrix[axis, 3]
        moved[finite, axis] = ((rotation[0] * x + rotation[1] * y) + rotation[2] * z) + translation
    return moved


def _is_repeat(sweep: Sweep, newer: Sweep) -> bool:
    if (sweep.pose is None) != (newer.pose is None):
        return False
    same_pose = sweep.pose is None or np.array_equal(_matrix(sweep.pose), _matrix(newer.pose))
    return same_pose and np.array_equal(_matrix(sweep.points), _matrix(newer.points), equal_nan=True)


def _takes_part(sweep: Sweep, config: Config) -> np.ndarray:
    keeps = np.isfinite(xyz(sweep)).all(axis=1)
    if config.ego_box is not None:
        x0, y0, x1, y1 = config.ego_box
        x, y = xyz(sweep)[:, :2].T.astype(np.float64)
        keeps &= ~((x0 <= x) & (x <= x1) & (y0 <= y) & (y <= y1))
    if sweep.is_ground is None:
        return keeps
    return keeps & ~_matrix(sweep.is_ground).astype(bool)


def ground_points(sweep: Sweep, cloud: Cloud) -> np.ndarray:
    """(N, 3) float64, metres, frame of t+1: the ground of a sweep; none where it is not known."""
    if sweep.is_ground is None:
        return np.zeros((0, 3))
    return cloud.points[_matrix(sweep.is_ground).astype(bool) & np.isfinite(cloud.points).all(axis=1)]


def xyz(sweep: Sweep) -> np.ndarray:
    """(N, 3) float64, metres: the points of a sweep as they were given, without further columns."""
    return _matrix(sweep.points)[:, :3]


def _matrix(values: Any) -> np.ndarray:
    """The door: a float64 array from an array or a tensor on any device."""
    if isinstance(values, torch.Tensor):
        values = values.detach().cpu().double().numpy()
    return np.array(values, dtype=np.float64)
