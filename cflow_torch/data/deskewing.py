"""De-skew the sweeps of a log: by times of points, by the azimuth, or by what leaves the static world in place."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from cflow_torch.data.finding import FOUND, RIGHT, Finding
from cflow_torch.data.log import FlowLabels, Log, LogWrapper, intervals_of, typical_sweeps
from cflow_torch.data.log_motion import judge_log, steps_of
from cflow_torch.diagnosis.readings import Judgement
from cflow_torch.transforms import poses_at, relative_transform, transform_each, transform_points
from cflow_torch.types import CFlowError, Sweep, as_numpy
from cflow_torch.windows.deskewing import DIRECTIONS, ENDINGS, SCANS, deskew_points, scan_fractions

_CHOICES = ("auto", "times", "off", *DIRECTIONS)
_DYNAMIC = 0.05  # metres a sweep; labels of objects that move less stay static
_SLICE = 1e-4  # seconds during which we use one pose of a trajectory: 3 mm at 30 m/s
_INTERVAL = 0.1  # seconds between sweeps without time stamps, as models assume, and of a usual turn
_LONG = 1.5  # interval between sweeps over such a turn, from which sweeps may be left out
_INSTANTS = {"start": "the instant is the start of a turn", "end": "the instant is the end of a turn"}


def check_deskew(deskew: Any) -> None:
    """Refuse what `DeskewedLog` does not know."""
    if deskew not in (*_CHOICES, *SCANS):
        raise CFlowError(f"deskew={deskew!r}: choose one of {', '.join(_CHOICES)}, or a direction {ENDINGS}")


class DeskewedLog(LogWrapper):
    """A log whose points are moved by the ego motion to the instant of their sweep, see `deskew_points`.

    Args:
        log: the log; sweeps without poses stay as they are.
        deskew: "times" = by `Sweep.point_times`; "clockwise", "counterclockwise", "clockwise_left_at_start", ... = by
            the azimuth, see `scan_fractions`; "off" = the sweeps are compensated already; "auto" = the scan under which
            the static world stands still best (`cflow_torch.diagnosis.readings`). Without a clear one, points with
            times of raw points are moved by these, and others stay.
        turn_seconds: duration of a turn; None = that of the reader (`Log.turn_seconds`), or the median interval. If
            this is long, sweeps may be left out: then we compare it with a tenth of a second.

    Attributes:
        scan: how the sweeps are read, a value of `deskew` but "auto". It is decided at first use, by the log alone.

    Convention:
        - The motion between neighbouring poses has a constant velocity and rotation rate. Before the first and after
          the last pose, it continues.
        - Points that are moved by their azimuth get `point_times`, from which the verified method corrects the motion
          of objects. The instant of their sweep is when the LiDAR looks ahead, or the start or the end of the turn.
        - Times that are all equal do not say anything, and are ignored.
        - Labels keep the residual flow of static points. By the azimuth, we take those of dynamic points as motions
          between points as measured, because boxes are drawn around these. So we move both ends to the instants of
          their sweeps, and divide the motion by the turns between the two measurements.
    """

    def __init__(self, log: Log, deskew: str = "auto", turn_seconds: float | None = None) -> None:
        check_deskew(deskew)
        super().__init__(log)
        self._deskew = deskew
        self._turn_seconds = turn_seconds or log.unwrapped.turn_seconds

    @property
    def unmoved(self) -> Log:
        return self if self.scan == "off" else self.log

    @cached_property
    def scan(self) -> str:
        judgement = self.judgement if self._deskew == "auto" and len(self._scans) > 1 else None
        return self._scans[0] if judgement is None or not judgement.scan else judgement.scan

    @cached_property
    def judgement(self) -> Judgement | None:
        """How well scans and readings of the poses fit; None = a sweep cannot be read, and `sweep` raises its error."""
        try:
            return judge_log(self.log, self._place, self._scans)
        except (CFlowError, OSError):
            return None

    def findings(self) -> list[Finding]:
        note = self._note_of(self.scan) if self._deskew == "auto" else ""
        times = self.log.sweep(0).point_times
        if self._deskew != "auto":
            text = f"as you say, deskew={self._deskew}"
        elif times is None:
            text = "no times of points, and no other reading fits clearly better than as stored"
        else:
            text = f"points have times over {np.ptp(as_numpy(times)) if len(times) else 0.0:.3f} s"
        found = Finding("de-skewing", FOUND, note, True) if note else Finding("de-skewing", RIGHT, text)
        return [*self.log.findings(), found]

    @cached_property
    def _scans(self) -> tuple[str, ...]:
        """Return how the sweeps may be scanned; the first is what we expect.

        Logs of formats that are known to be compensated stay as they are (`Log.is_compensated`), and so do logs without
        `poses`. Times of points are expected to be those of raw points if the reader says so (`Log.has_raw_times`).
        """
        if self._deskew != "auto":
            return (self._deskew,)
        own = self.log.unwrapped
        if own.is_compensated or self.poses is None:
            return ("off",)
        times = self.log.sweep(typical_sweeps(self.log)[0]).point_times
        if times is None or not len(times) or np.ptp(as_numpy(times)) == 0:  # equal times do not say anything
            return ("off", *DIRECTIONS)
        return ("times", "off", *DIRECTIONS) if own.has_raw_times else ("off", "times", *DIRECTIONS)

    def _place(self, index: int, sweep: Sweep, rows: np.ndarray, scan: str) -> np.ndarray:
        points = as_numpy(sweep.points)[rows, :3].astype(np.float64)
        return points if scan == "off" else self.move(points, self.seconds(sweep, scan, rows), index, scan)

    def _note_of(self, scan: str) -> str:
        """Return what the user should know of the scan that was found."""
        if scan == "off" and not (self.log.unwrapped.has_raw_times and self._scans[0] == "times"):
            return ""
        shares = {} if self.judgement is None else self.judgement.shares_of_scans
        compared = ", ".join(f"{share:.0%} with {name}" for name, share in shares.items())
        measured = f" (of the static structure, {compared} is in place some metres later)" if compared else ""
        same = f"data.deskew={scan} does the same without this line"
        if scan == "off":
            return f"its points have times, but seem to be de-skewed already, so we leave them{measured}. {same}"
        instant = _INSTANTS.get(scan.partition("_at_")[2], "ahead = the instant")
        by = "the times of its points" if scan == "times" else f"the azimuth ({scan}; {instant})"
        moved = f"its sweeps are not de-skewed, so we move each point by the ego motion according to {by}"
        return f"{moved}{measured}. {same}, data.deskew=off leaves the points as they are"

    def sweep(self, index: int) -> Sweep:
        reading = self.scan
        sweep = self.log.sweep(index)
        if reading == "off":
            return sweep
        if sweep.pose is None:
            self._note(f"deskew={reading} needs poses, and sweep {index} has none: try data.odometry=true", "no poses")
            return sweep
        if reading == "times" != self._deskew and sweep.point_times is None:
            self._note(f"sweep {index} has no times of points and stays as it is, also others", "sweeps without times")
            return sweep
        seconds = self.seconds(sweep, reading, slice(None))
        points = self.move(as_numpy(sweep.points), seconds, index, reading)
        times = np.nan_to_num(seconds).astype(np.float32)  # points that are not finite have no azimuth
        return replace(sweep, points=points, point_times=times)

    def seconds(self, sweep: Sweep, reading: str, rows: Any) -> np.ndarray:
        """Return the time from the instant of a sweep to some of its measurements, (N,) float64 seconds."""
        if reading != "times":
            return self._seconds_by_azimuth(as_numpy(sweep.points)[rows], reading)
        if sweep.point_times is None:
            others = ", ".join(name for name in _CHOICES if name != "times")
            raise CFlowError(f"log {self.log_id} has no times of points for deskew=times: choose one of {others}")
        return as_numpy(sweep.point_times)[rows].astype(np.float64)

    def _seconds_by_azimuth(self, points: np.ndarray, direction: str) -> np.ndarray:
        return self._interval * scan_fractions(points, direction, self.log.unwrapped.lidar_position)

    def move(self, points: np.ndarray, seconds: np.ndarray, index: int, reading: str) -> np.ndarray:
        """Move points of sweep `index`, (N, 3+), by the ego motion in the (N,) `seconds` to their measurement."""
        if self.trajectory is not None:
            return self._move_along(self.trajectory, points, seconds, index)
        before = max(index - 1, 0)
        after = min(index, len(self) - 2)
        if before in self._long_steps:  # the motion over a gap does not tell that within a sweep
            before = after
        elif after in self._long_steps:
            after = before
        gaps = self._gaps[[before, after]]
        if reading != "times":  # A pose interval is one turn, or several if sweeps are missing: stamps may be rounded.
            gaps = self._interval * np.maximum(np.round(gaps / self._interval), 1)
        fraction = seconds / np.where(seconds > 0, gaps[1], gaps[0])
        return deskew_points(points, fraction, self._motion(after), self._motion(before))

    def _move_along(self, trajectory: Any, points: np.ndarray, seconds: np.ndarray, index: int) -> np.ndarray:
        """Move points by a trajectory that has more poses than one per sweep."""
        of_point = np.round(np.nan_to_num(seconds) / _SLICE).astype(np.int64)
        shots, group = np.unique(of_point, return_inverse=True)
        at = poses_at(self.timestamps[index] + shots * round(_SLICE * 1e9), *trajectory)
        poses: Any = self.poses
        return transform_each(points[:, :3], (np.linalg.inv(poses[index]) @ at)[group]).astype(points.dtype)

    def labels(self, index: int) -> FlowLabels | None:
        labels = self.log.labels(index)
        reading = self.scan
        stored = self.log.sweep(index) if labels is not None and reading != "off" else None
        if labels is None or stored is None or stored.pose is None:
            return labels
        T_ego1_ego0 = self._motion(index)
        start = as_numpy(stored.points)[:, :3].astype(np.float64)
        end = start + labels.flow
        residual = end - transform_points(start, T_ego1_ego0)
        moved = as_numpy(self.sweep(index).points)[:, :3].astype(np.float64)
        if reading != "times":
            rows = np.flatnonzero(np.linalg.norm(residual, axis=1) >= _DYNAMIC)
            before = self.seconds(stored, reading, rows)
            after = self._seconds_by_azimuth(end[rows], reading)
            reached = self.move(end[rows], after, index + 1, reading)
            turns = 1 + (after - before) / self._interval
            turns = np.where((turns > 0.5) & (turns < 1.5), turns, 1)  # else the object passes the seam of the turn
            residual[rows] = (reached - transform_points(moved[rows], T_ego1_ego0)) / turns[:, None]
        flow = transform_points(moved, T_ego1_ego0) + residual - moved
        flow = np.where(np.isfinite(flow), flow, labels.flow)
        return replace(labels, flow=flow.astype(labels.flow.dtype))

    def _motion(self, index: int) -> np.ndarray:
        """Return `T_ego1_ego0` of the pair (index, index + 1)."""
        known = self.poses
        poses = [self.log.sweep(k).pose if known is None else known[k] for k in (index, index + 1)]
        return relative_transform(poses[1], poses[0])

    @cached_property
    def _long_steps(self) -> frozenset[int]:
        """The gaps of the log and, if sweeps have no times, the steps over which some seem to be missing."""
        steps = steps_of(self.log) if intervals_of(self.log) is None else None
        return self.gaps if steps is None else self.gaps.union(np.flatnonzero(steps.is_long).tolist())

    @cached_property
    def _gaps(self) -> np.ndarray:
        """(K-1,) float64 seconds from each sweep to the next."""
        known = intervals_of(self.log)
        return np.full(len(self) - 1, _INTERVAL) if known is None else np.where(known > 0, known, _INTERVAL)

    @cached_property
    def _interval(self) -> float:
        """Seconds of one turn.

        If sweeps of a slow log may be left out, it is the interval or a tenth of a second, whichever fits better.
        """
        usual = float(np.median(self._gaps))
        if self._turn_seconds or usual < _LONG * _INTERVAL or self.poses is None or self._scans[-1] not in SCANS:
            return self._turn_seconds or usual
        judged = {seconds: DeskewedLog(self.log, self._deskew, seconds).judgement for seconds in (usual, _INTERVAL)}
        return max(judged, key=lambda seconds: np.nan_to_num(getattr(judged[seconds], "fits", 0)))  # ties: the interval
