"""Find likely mistakes in a log before its flow is used: units, axes, ground, de-skewing, repeated sweeps, poses."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.errors import CFlowError, warn
from cflow_torch.windows.ego_motion import rigid_transform
from cflow_torch.windows.ground import is_upside_down
from cflow_torch.windows.ground_plane import REACH
from cflow_torch.windows.inspection import BACKWARD, REPEATED, UPSIDE_DOWN, has_moved, is_backward, repeats
from cflow_torch.windows.structure import FEWEST_IN_PLACE, Patches, is_better_inverted, move, structure

BASELINE = 5  # sweeps from the older to the later one of a pair: only a turn of the vehicle shows a wrong frame
_PAIRS = 2  # pairs per log
_MOST_POINTS = 8000  # of the older sweep
# Tolerances. With correct poses, the shift was at most 13 mm on a real drive without de-skewing and 7 mm on simulated
# drives. At the beginning of a turn without de-skewing, it was 58 mm, with a rotation of 0.7 degrees.
_SHIFT, _SHIFT_PER_METRE, _SHIFT_PER_RADIAN = 0.03, 0.01, 10.0
_ROTATION = np.radians(1.5)
_BETTER, _GOOD = 2.0, 0.15  # poses do not fit if the identity agrees better by this factor, and at least this well
# They do not fit, either, if both agreements (before, after alignment) are below these shares of the best possible.
# Correct poses gave 0.27 in that turn, else above 0.5. A LiDAR at a wrong position gave 0.7 or more after alignment.
_HOPELESS, _ALIGNED = 0.2, 0.5


@dataclass(frozen=True)
class StaticResidual:
    """Motion of the static world that remains after ego motion is removed, between the sweeps `index` and `later`."""

    index: int
    later: int
    # (2,) float64, x and y, metres, frame of `later`. After the transform by the poses, `rotation` and `shift` move the
    # structure of `index` onto the structure of `later`.
    shift: np.ndarray
    rotation: float  # radians about z
    # 0 ... 1, how well the structures coincide under the poses: 0.3 to 0.5 on a street. NaN = too few points to judge.
    agreement: float
    aligned: float  # agreement after `shift` and `rotation` are removed
    verdict: str  # the likely mistake, "" = none


def static_world_residual(log: Log, index: int, baseline: int = BASELINE) -> StaticResidual:
    """Compare the sweeps `index` and `index + baseline` of a log in one frame.

    Without poses the sensor is assumed to be static. Without ground masks, a simple rule removes low points. Only the
    horizontal plane is compared. The points of the later sweep above ground, 2.5 to 50 m away, become Gaussian patches
    in cells of 1 m. A Gauss-Newton fit with robust weights (for moving objects) finds the shift and rotation that align
    the older sweep with them. Along a wall without corners no shift is detected. If the LiDAR is not where the poses
    assume it, a shift appears only when the vehicle turns. It is the offset of the LiDAR times the rotation: 12 cm
    for 1.35 m and 5 degrees.

    Cost: reads two sweeps and takes about 0.15 s on one core.

    Source: the fit is the normal distributions transform in the plane (Biber and Strasser, 2003).
    """
    older, newer = log.sweep(index), log.sweep(index + baseline)
    has_poses = older.pose is not None and newer.pose is not None
    pose0, pose1 = (rigid_transform(s.pose, "pose") if has_poses else np.eye(4) for s in (older, newer))
    T_1_0 = np.linalg.inv(pose1) @ pose0
    source, target = structure(older), structure(newer)[:, :2]
    patches = Patches(target)
    source = source[np.random.default_rng(0).permutation(len(source))[:_MOST_POINTS]]
    moved = move(source, T_1_0)
    agreement, (shift, rotation, aligned) = patches.agreement(moved), patches.fit(moved)
    best = patches.agreement(target)  # of the later sweep with itself: an upper bound for other sweeps
    if best * min(len(source), len(target)) < FEWEST_IN_PLACE:
        return StaticResidual(index, index + baseline, shift, rotation, float("nan"), float("nan"), "")
    inverted = patches.agreement(move(source, pose1 @ np.linalg.inv(pose0)))
    unmoved = patches.agreement(source[:, :2])
    size, distance = float(np.linalg.norm(shift)), float(np.linalg.norm(T_1_0[:3, 3]))
    verdict = ""
    if is_better_inverted(agreement, unmoved, inverted):
        verdict = "The poses seem to be inverted. They must map ego coordinates to the world (T_world_ego)."
    elif unmoved > max(_BETTER * agreement, _GOOD) or max(agreement / _HOPELESS, aligned / _ALIGNED) < best:
        verdict = (
            "The sweeps do not fit. Do the poses have another log, other axes (a camera's), times or units? Or are the "
            "points already in one common frame (then pass no poses)?"
        )
    elif abs(rotation) > _ROTATION or size > _SHIFT + _SHIFT_PER_METRE * distance + _SHIFT_PER_RADIAN * abs(rotation):
        verdict = (
            f"It is off by {100 * size:.0f} cm and {np.degrees(abs(rotation)):.1f} degrees. Points in the frame of the "
            "LiDAR with poses of the vehicle cause this in turns: pass ego_T_lidar. Other causes: axes or times of the "
            "poses, sweeps that are not de-skewed."
        )
    if verdict and not has_poses:
        verdict = (
            "There are no poses, but the sensor seems to move. Pass poses, or set data.odometry=true (in Python "
            "`with_poses` of cflow_torch.data.odometry)."
        )
    return StaticResidual(index, index + baseline, shift, rotation, agreement, aligned, verdict)


def check_static_world(log: Log) -> list[StaticResidual]:
    """Measure whether the static world moves between two sweeps of a log, and warn if it does.

    We compare up to two pairs of sweeps and return their residuals. If the log has the attribute `poses`, we choose the
    pairs over which the vehicle turns most, otherwise the first and the last pair. A log of one sweep has no pair. The
    warning gives the verdict on the worst pair.

    Cost: reads two sweeps per pair; 0.15 s each.
    """
    found = _residuals(log)
    if _worst(found):
        warn(f"log {log.log_id}: {_worst(found)}")
    return found


def _worst(found: list[StaticResidual]) -> str:
    bad = [residual for residual in found if residual.verdict]
    if not bad:
        return ""
    worst = max(bad, key=lambda residual: float(np.linalg.norm(residual.shift)))
    return f"from sweep {worst.index} to {worst.later} the static world moves. {worst.verdict}"


def _residuals(log: Log) -> list[StaticResidual]:
    baseline = min(BASELINE, len(log.timestamps) - 1)
    return [static_world_residual(log, index, baseline) for index in _choose(log, baseline)] if baseline > 0 else []


def _choose(log: Any, baseline: int) -> list[int]:
    """Return the index of the first sweep of each pair. Pairs do not overlap; the largest rotation comes first."""
    last = len(log.timestamps) - 1 - baseline
    poses: np.ndarray | None = getattr(log, "poses", None)
    if poses is None:
        return sorted({0, last})
    relative = np.linalg.inv(poses[baseline:]) @ poses[:-baseline]
    order = np.argsort(-np.abs(np.arctan2(relative[:, 1, 0], relative[:, 0, 0])), kind="stable")
    chosen: list[int] = []
    for index in order.tolist():
        if len(chosen) < _PAIRS and all(abs(index - other) >= baseline for other in chosen):
            chosen.append(index)
    return chosen


_SMALLEST = 2.0  # metres; if all points are closer to the origin, they are not in metres


def check_log(log: Log) -> None:
    """Give a `CFlowWarning` for each problem that `find_problems` lists."""
    for text in find_problems(log):
        warn(f"log {log.log_id}: {text}")


def find_problems(log: Log) -> list[str]:
    """List likely mistakes that raise no error, and say if we find the ground because masks are missing.

    We skip a check if a sweep that it needs cannot be read. Reading this sweep later raises the error.

    Cost: reads up to eight sweeps; about 0.4 s.
    """
    problems = []
    for check in (_points, _ground, _skew, _order, lambda log: _worst(_residuals(log))):
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


def _skew(log: Any) -> str:
    note = getattr(getattr(log, "reading", None), "note", "")
    sweep = log.sweep(0)
    if note or not getattr(log, "deskew", False) or sweep.pose is None or sweep.point_times is not None:
        return str(note)
    return (
        "it has no times of points, so its sweeps are not de-skewed, and static objects are smeared while the vehicle "
        "moves. If the clouds are already compensated, set data.deskew=off"
    )


def _order(log: Log) -> str:
    first = [log.sweep(index) for index in range(min(3, len(log.timestamps)))]
    for pc0, pc1 in zip(first, first[1:]):
        if repeats(pc0, pc1):
            return REPEATED
        if has_moved(pc0, pc1) and is_backward(pc0, pc1):
            return BACKWARD
    return ""
