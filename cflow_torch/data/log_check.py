"""Find likely mistakes in a log before its flow is used: units, axes, ground, de-skewing, repeated sweeps, poses."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.data.static_check import static_world_verdict
from cflow_torch.errors import CFlowError, warn
from cflow_torch.windows.ground import is_upside_down
from cflow_torch.windows.ground_plane import REACH
from cflow_torch.windows.inspection import BACKWARD, REPEATED, UPSIDE_DOWN, has_moved, is_backward, repeats

_SMALLEST = 2.0  # metres, extent of a sweep


def check_log(log: Log) -> None:
    """Warn of what `find_problems` finds, a `CFlowWarning` each."""
    for text in find_problems(log):
        warn(f"log {log.log_id}: {text}")


def find_problems(log: Log) -> list[str]:
    """List mistakes that do not show as an error in any single sweep, and what was done about missing ground masks.

    Args:
        log: any log. A sweep that cannot be read is skipped here; reading it later raises the error.

    Cost: reads up to eight sweeps; about 0.4 s.
    """
    problems = []
    for check in (_points, _ground, _skew, _order, static_world_verdict):
        with suppress(CFlowError, OSError):
            problems.append(check(log))
    return [text for text in problems if text]


def _points(log: Log) -> str:
    points = np.asarray(log.sweep(0).points)[:, :3]
    points = points[np.isfinite(points).all(1)]
    if len(points) == 0:
        return ""
    size = np.abs(points[:, :2]).max(1)
    if size.min() >= REACH or size.max() < _SMALLEST:
        return (
            f"the points of its first sweep are {size.min():.4g} to {size.max():.4g} m away from the origin: are they "
            "in metres, in the frame of the LiDAR or of the vehicle?"
        )
    return UPSIDE_DOWN if is_upside_down(points) else ""


def _ground(log: Any) -> str:
    log.sweep(0)
    if not getattr(log, "has_found_ground", False):
        return ""
    return (
        "it has no ground masks, so we find the ground (find_ground=auto). data.find_ground=grid does the same without "
        "this line, data.find_ground=null leaves all points in"
    )


def _skew(log: Log) -> str:
    sweep = log.sweep(0)
    if not getattr(log, "deskew", False) or sweep.pose is None or sweep.point_times is not None:
        return ""
    return (
        "it has no times of points, so its sweeps are not de-skewed, and static objects are smeared while the vehicle "
        "moves. If the clouds are already compensated, set data.deskew=false"
    )


def _order(log: Log) -> str:
    """Compare the first sweeps in a row."""
    first = [log.sweep(index) for index in range(min(3, len(log.timestamps)))]
    for pc0, pc1 in zip(first, first[1:]):
        if repeats(pc0, pc1):
            return REPEATED
        if has_moved(pc0, pc1) and is_backward(pc0, pc1):
            return BACKWARD
    return ""
