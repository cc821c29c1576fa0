"""Warn of input that is allowed, but likely a mistake: units, axes, poses, repeated sweeps, ground without a mask."""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.diagnosis.conventions import INVERTED, STILL, WORLD
from cflow_torch.diagnosis.pair import make_pair
from cflow_torch.diagnosis.point_frame import column_problem, frame_problem, tilt_problem
from cflow_torch.diagnosis.readings import INACCURATE, NO_READING, UNKNOWN, judge
from cflow_torch.diagnosis.stillness import LEAST_SHARE, MISPLACED, are_finite, cell_keys, share_of_sweeps
from cflow_torch.errors import warn
from cflow_torch.ground.segmentation import find_ground, has_ground
from cflow_torch.transforms import relative_transform, transform_points
from cflow_torch.types import MOVING, FlowResult, Sweep, Window, as_numpy
from cflow_torch.windows.returns import MISSING, without_missing
from cflow_torch.windows.validation import have_same_points

REPEATED = "pc1 has the same points as pc0, so everything seems to move with the sensor: give two different sweeps"
_EMPTY = "pc1 has no finite points, so everything in pc0 seems to vanish: give the points of the next sweep"
_GROUND = (
    "contains ground, which joins the objects on it into one cluster, so moving objects are missed: give masks of the "
    "ground (Sweep.is_ground, see cflow_torch.ground.find_ground)"
)
# Correlation of a ground mask with the ground that we find; of right ones, 0.85 to 0.97. Masks of a height alone have
# 0.54 to 0.9, those of the next sweep up to 0.72. But points of a voxel then differ more often, by this factor.
_MISFIT, _UNLIKE, _MIXED = 0.3, 0.75, 2.0
_VOXEL, _FEWEST_IN_VOXEL, _FAR = 0.3, 3, 1e4  # metres, points, metres
_MOST_OF_MASK = 0.9  # share of a mask that is ground as we find it, from which it is right
_MOST_MASKED = 20_000  # points of a ground mask that are compared
# What to do about a `Judgement` of two sweeps, by the first of its best readings.
_ADVICE = {
    INVERTED: "poses must be T_world_ego, and T_ego1_ego0 maps from t to t+1",
    STILL: "if the clouds are in one frame, leave out the transforms and poses",
    WORLD: "move them to the frame of the vehicle, or leave out the transforms and poses",
    UNKNOWN: "give T_ego1_ego0, or poses, unless most of the scene moves",
    INACCURATE: "give more exact poses (T_ego1_ego0)",
    NO_READING: "check frame, units and times of the poses (T_ego1_ego0)",
}
_ADVICE_ELSE = "convert the poses (T_ego1_ego0) to the frame of the points, in metres"
_HISTORY = (
    "the first sweep of the history does not fit pc0, which fits pc1, so it has points or a pose of another time: give "
    "the sweeps before pc0 with their own poses, the nearest first"
)
_OTHER_TIME = (
    "the second sweep does not fit the first one, which fits those before, so it has points or a pose of another time, "
    "or sweeps are interchanged"
)
_CORRECTED = (
    "so the poses are off. We corrected them for the flow; for maps and tracks, correct them yourself (for logs: "
    "data.odometry=refine)"
)
_WITHOUT_POSES = (
    "and there are no poses. This motion is in the pose flow, not in the residual flow; give poses (for logs: "
    "data.odometry=true)"
)
_MOST_COMPARED, _LEAST_CORRECTION = 64, 1e-3  # points, metres; the pose flow is rounded
# A share of moving points is suspicious if it is this many times larger than the usual one and a slack.
_SUSPICIOUS, _SLACK, _FEWEST_WATCHED = 1.5, 0.05, 500
_SHORTEST, _LONGEST = 0.002, 2.0  # seconds between sweeps; in another unit, they are at least a thousand times off
_FEWEST_REPEATED = 100  # this many equal points are no coincidence


class Inspection:
    """Warns of likely mistakes in windows. `estimate_flow`, `FlowStream` and the integrations call it.

    In every window, it checks that pc1 has points, other than pc0. It makes the other checks once each, only in the
    first window of a call. Once such a window has points, it checks units, axes, ground, times and missing returns.
    Once such a window has static structure, it checks the ego motion, and whether the history fits. Cost: about 100 ms,
    once; 0.1 ms for each window.
    """

    def __init__(self) -> None:
        self._has_seen_points = self._has_seen_structure = False

    def __call__(self, windows: Sequence[Window]) -> None:
        problems = [pair_problem(window.pc0, window.pc1) for window in windows]
        for problem in filter(None, problems):
            warn(problem)
        if not windows or len(windows[0].pc0.points) == 0:
            return
        first = windows[0]
        if not self._has_seen_points:
            self._has_seen_points = True
            problem = column_problem(first.pc0.points) or frame_problem(first.pc0.points)[1]
            self._has_seen_structure = bool(problem)  # in another frame, readings of the poses mean nothing
            problem = problem or tilt_problem([first.pc0.points]) or _ground_problem(first.pc0)
            if problem:
                warn(problem)
            problem = _interval_problem(first)
            if problem:
                warn(problem)
            _, num_missing = without_missing(first.pc0)
            if num_missing:
                warn(f"{num_missing} {MISSING}: leave them out, or make them NaN")
        if not self._has_seen_structure and not problems[0]:
            judgement = judge([make_pair(first.pc0, first.pc1)])
            self._has_seen_structure = bool(judgement.shares)
            if judgement.best:
                warn(f"{judgement}: {_ADVICE.get(judgement.best[0], _ADVICE_ELSE)}")
            elif first.pch and _fits_only(first.pc0, first.pc1, first.pch[0]):
                warn(_HISTORY)


def is_usual_interval(seconds: float) -> bool:
    """Test whether sweeps may be so far apart, if their times have the right unit."""
    return _SHORTEST <= seconds <= _LONGEST


def _interval_problem(window: Window) -> str:
    """Return what is wrong with the times of a pair; "" = nothing, or they are unknown."""
    first, second = window.pc0.timestamp_ns, window.pc1.timestamp_ns
    if first is None or second is None:
        return ""
    seconds = (second - first) * 1e-9
    if is_usual_interval(seconds):
        return ""
    return f"pc1 is {seconds:.3g} s after pc0: give times in nanoseconds (int), or to FlowStream in seconds (float)"


def _ground_problem(pc0: Sweep) -> str:
    """Return what is wrong with the ground mask of pc0, or that it lacks one; "" = nothing."""
    if pc0.is_ground is None:
        missed = f"a sweep without a ground mask {_GROUND}, all False if this is not ground"
        return missed if has_ground(pc0.points) else ""
    if not as_numpy(pc0.is_ground).any():  # you say that there is no ground
        return ""
    problem = mask_problem(pc0)
    return problem and f"the ground mask of pc0 is {problem}"


def mask_problem(sweep: Sweep) -> str:
    """Return what is wrong with the ground mask that a sweep has, in metres and z up; "" = nothing. Cost: 10 ms."""
    rows = slice(None, None, len(sweep.points) // _MOST_MASKED + 1)
    points = as_numpy(sweep.points)[rows, :3]
    given: Any = sweep.is_ground
    mask = as_numpy(given)[rows]
    is_known = are_finite(points)
    if not is_known.any():
        return ""
    if mask.all():
        return "that of all points, so no point would have flow: give masks of the ground alone, or none"
    found = as_numpy(find_ground(points))
    if not mask.any():
        return f"empty, but the sweep {_GROUND}; is_ground=None is 'unknown'" if found.any() else ""
    both = np.stack([found, mask])[:, is_known].astype(np.float64)
    fit = float(np.corrcoef(both)[0, 1]) if (np.ptp(both, axis=1) > 0).all() else 1.0
    if fit > _UNLIKE or found[mask & is_known].mean() > _MOST_OF_MASK:  # the mask may be that of the road alone
        return ""
    of_found, of_mask = (_mixture(points[is_known], each) for each in both)
    if fit > _MISFIT and not of_mask > _MIXED * of_found:
        return ""
    fix = "invert the mask, True = ground" if fit < -_MISFIT else "has it the rows of this sweep, in their order?"
    return f"not that of points that lie low: {fix}"


def _mixture(points: np.ndarray, mask: np.ndarray) -> float:
    """Return how often points of a voxel differ in a mask, (N,) float, over how often any two do."""
    voxel = cell_keys(np.floor(points[:, :3].astype(np.float64).clip(-_FAR, _FAR) / _VOXEL).astype(np.int64))
    _, of_point, count = np.unique(voxel, return_inverse=True, return_counts=True)
    share = np.bincount(of_point, mask) / count
    is_shown = count >= _FEWEST_IN_VOXEL
    share, count = share[is_shown], count[is_shown]
    if not len(count):
        return 0.0
    mean = float(np.average(share, weights=count))
    return float(np.average(share * (1 - share) * count / (count - 1), weights=count)) / max(mean * (1 - mean), 1e-9)


def pose_error(window: Window, result: FlowResult) -> float:
    """Return how far the method moved the valid points of pc0 to correct the ego motion, metres; 0 = not at all.

    Cost: 0.2 ms. It compares 64 points.
    """
    points = window.pc0.points
    rows = np.flatnonzero(as_numpy(result.is_valid))
    rows = rows[:: len(rows) // _MOST_COMPARED + 1]
    position = as_numpy(points[rows])[:, :3].astype(np.float64)
    given = np.zeros_like(position)
    if window.pc0.pose is not None and window.pc1.pose is not None:
        given = transform_points(position, relative_transform(window.pc1.pose, window.pc0.pose)) - position
    apart = np.linalg.norm(as_numpy(result.pose_flow[rows]) - given, axis=1)
    largest = float(apart.max(initial=0))
    return largest if largest > _LEAST_CORRECTION else 0.0


class MotionWatch:
    """Watches the pairs of a log for poses that the method corrects, and for sweeps or poses of another time.

    In a pair of another time, far more points move than in the pair before. The flow gives the suspicion, and the
    static structure must confirm it: it is in place in pc0, but not in pc1. Cost: 0.3 ms a pair, and 60 ms for a
    suspicious one.
    """

    def __init__(self) -> None:
        self._usual: float | None = None  # share of the points that moved in the pair before
        self._has_told_error = False

    def __call__(self, window: Window, result: FlowResult) -> str:
        """Return what is wrong with the next pair of the log; "" = nothing. Corrected poses are told once."""
        problem = self._other_time(window, result)
        error = 0.0 if problem or self._has_told_error else pose_error(window, result)
        if not error:
            return problem
        self._has_told_error = True
        what = f"the static world moves by up to {100 * error:.0f} cm between two sweeps"
        return f"{what}, {_WITHOUT_POSES if window.pc0.pose is None else _CORRECTED}"

    def _other_time(self, window: Window, result: FlowResult) -> str:
        """Return that a sweep or pose of the pair is of another time; "" = it is not."""
        count = int(result.is_valid.sum())
        if count < _FEWEST_WATCHED:
            return ""
        moves = torch.linalg.vector_norm(result.residual_flow, dim=1) >= MOVING
        share = int((moves & result.is_valid).sum()) / count
        is_suspicious = self._usual is not None and share > _SUSPICIOUS * (self._usual + _SLACK)
        if is_suspicious and window.pch and _fits_only(window.pc0, window.pch[0], window.pc1):
            return f"{share:.0%} of the points move, {self._usual:.0%} in the pair before: {_OTHER_TIME}"
        self._usual = share
        return ""


def _fits_only(sweep: Sweep, one: Sweep, other: Sweep) -> bool:
    """Test whether a sweep fits one of its neighbours, but not the other one."""
    share, of_other = (share_of_sweeps(sweep, each) for each in (one, other))
    return share >= LEAST_SHARE and of_other < MISPLACED * share


def pair_problem(pc0: Sweep, pc1: Sweep) -> str:
    """Return what is wrong with the second of two sweeps; "" = nothing, or its points are on a GPU."""
    points = pc1.points
    if isinstance(points, torch.Tensor) and points.device.type != "cpu":
        return ""
    is_empty = len(pc0.points) > 0 and not np.isfinite(as_numpy(points)[:, 0]).any()
    return _EMPTY if is_empty else REPEATED if repeats(pc0, pc1) else ""


def repeats(pc0: Sweep, pc1: Sweep) -> bool:
    """Test whether two sweeps have the same points, at least 100, some finite. False on a GPU, so as not to wait."""
    for points in (pc0.points, pc1.points):
        if len(points) < _FEWEST_REPEATED or (isinstance(points, torch.Tensor) and points.device.type != "cpu"):
            return False
    return have_same_points(pc0, pc1) and bool(are_finite(as_numpy(pc0.points)).any())


def inactive_problems(windows: Sequence[Window], results: Sequence[FlowResult], config: Config) -> list[str]:
    """Return what is wrong with each window whose pc0 has rows, but no active point; "" = nothing.

    Active points are finite, in the region, neither ground nor of the vehicle. Without one, no row has a result. Cost:
    the host waits for the device once.
    """
    is_used = torch.stack([result.is_valid.any() for result in results]).tolist() if results else []
    problems = []
    for window, used in zip(windows, is_used):
        if used or len(window.pc0.points) == 0:
            problems.append("")
            continue
        positions = as_numpy(window.pc0.points)[:, :3]
        finite = positions[are_finite(positions)]
        seen = "all are NaN or infinite"
        if len(finite):
            spans = zip("xyz", finite.min(axis=0), finite.max(axis=0))
            extent = ", ".join(f"{axis} {low:.6g} to {high:.6g}" for axis, low, high in spans)
            seen = f"they span {extent} in their own frame"
        problems.append(
            f"none of the {len(positions)} points of pc0 is active ({seen}): are they metres, near the ego vehicle, "
            f"and not all of them ground? point_cloud_range={config.point_cloud_range}, in the ego frame at t+1"
        )
    return problems
