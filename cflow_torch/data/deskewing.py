"""De-skew the sweeps of a log: by times of points, by the azimuth, or by what leaves the static world in place."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, Sequence

import numpy as np

from cflow_torch.data.log import CachedLog, FlowLabels, Log, LogWrapper
from cflow_torch.data.rigid_motion import transform_points
from cflow_torch.types import CFlowError, Sweep, as_numpy
from cflow_torch.windows.deskewing import DIRECTIONS, SCANS, STARTS, deskew_points, scan_fractions
from cflow_torch.windows.ego_motion import relative_transform
from cflow_torch.windows.stillness import share_in_place, static_rows, thinned_rows

CHOICES = ("auto", "times", "off", *SCANS)
_DYNAMIC = 0.05  # metres a sweep; labels of objects that move less stay static
_INTERVAL = 0.1  # seconds between sweeps without time stamps, as models assume
_LEAST_MOTION = 0.5  # metres a sweep; below, a wrong reading moves static objects by millimetres only
# The later sweep of a pair comes after about 6 m, at most 5 sweeps. There, a wrong reading shows several times as
# clearly as between neighbours, and most of the structure is still in view.
_BASELINE = 6.0
_MOST_SWEEPS = 5
_PAIRS = 3
_MOST_POINTS = 3000  # of the earlier sweep; the share is then within 0.008
_FEWEST_POINTS = 300
# The best share must be larger than the next one by this factor. For raw drives it was larger by 1.2 at 1.2 m a sweep,
# and by 1.3 at 2 m, by 1.055 at 0.6 m. For compensated drives, the factor of a wrong reading was at most 1.02.
_CLEARLY = 1.08
_LIKELY = 1.03  # for the order of the readings, and for another start of the turn
# After a shift along the path (metres), the share must be smaller by this factor. It was 1.6 on raw drives.
_SHIFT, _PEAK = 0.15, 1.2


class Reading(NamedTuple):
    """How the sweeps of a log are read."""

    name: str  # one of `CHOICES` but "auto"
    note: str = ""  # what "auto" found, for the user; "" = nothing to tell


class DeskewedLog(LogWrapper):
    """A log whose points are moved by the ego motion to the instant of their sweep, see `deskew_points`.

    Args:
        log: the log; sweeps without poses stay as they are.
        deskew: "times" = by `Sweep.point_times`; "clockwise", "counterclockwise", "clockwise_left", ... = by the
            azimuth, see `scan_fractions`; "off" = the sweeps are compensated already; "auto" = by `choose_reading`.

    Attributes:
        reading: the `Reading` in use. It is decided at first use, from the log alone.

    Convention:
        - The motion between neighbouring poses has a constant velocity and rotation rate. Before the first and after
          the last pose, it continues.
        - Points that are moved by their azimuth get `point_times`, from which the verified method corrects the motion
          of objects. The instant of their sweep is when the LiDAR looks ahead.
        - Labels keep the residual flow of static points. By the azimuth, we take those of dynamic points as motions
          between points as measured, because boxes are drawn around these. So we move both ends to the instants of
          their sweeps, and divide the motion by the turns between the two measurements.
    """

    def __init__(self, log: Log, deskew: str = "auto") -> None:
        if deskew not in CHOICES:
            raise CFlowError(f"deskew={deskew!r}: choose one of {', '.join(CHOICES)}")
        super().__init__(log)
        self._deskew = deskew
        self._recent = CachedLog(log, 2)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_recent": CachedLog(self.log, 2)}

    @cached_property
    def reading(self) -> Reading:
        if self._deskew == "auto":
            return choose_reading(self)
        is_moved = self._deskew == "times" and has_moved_by_times(self)
        return Reading("off" if is_moved else self._deskew)

    def sweep(self, index: int) -> Sweep:
        return self.read(index, self.reading.name)

    def read(self, index: int, reading: str) -> Sweep:
        """Read a sweep under any reading, one of `CHOICES` but "auto"."""
        sweep = self._recent.sweep(index)
        if reading == "off" or sweep.pose is None:
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
            others = ", ".join(name for name in CHOICES if name != "times")
            raise CFlowError(f"log {self.log_id} has no times of points for deskew=times: choose one of {others}")
        return as_numpy(sweep.point_times)[rows].astype(np.float64)

    def _seconds_by_azimuth(self, points: np.ndarray, direction: str) -> np.ndarray:
        return self._interval * scan_fractions(points, direction, self.log.unwrapped.lidar_position)

    def move(self, points: np.ndarray, seconds: np.ndarray, index: int, reading: str) -> np.ndarray:
        """Move points of sweep `index`, (N, 3+), by the ego motion in the (N,) `seconds` to their measurement."""
        before = max(index - 1, 0)
        after = min(index, len(self) - 2)
        gaps = self._gaps[[before, after]]
        if reading != "times":  # A pose interval is one turn, or several if sweeps are missing: stamps may be rounded.
            gaps = self._interval * np.maximum(np.round(gaps / self._interval), 1)
        fraction = seconds / np.where(seconds > 0, gaps[1], gaps[0])
        return deskew_points(points, fraction, self._motion(after), self._motion(before))

    def labels(self, index: int) -> FlowLabels | None:
        labels = self.log.labels(index)
        reading = self.reading.name
        stored = self._recent.sweep(index) if labels is not None and reading != "off" else None
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

    @cached_property
    def ego_poses(self) -> np.ndarray | None:
        """(K, 4, 4) float64 `T_world_ego`; None if the log does not have them without reading points."""
        return getattr(self.log, "poses", None)

    def _motion(self, index: int) -> np.ndarray:
        """Return `T_ego1_ego0` of the pair (index, index + 1)."""
        known = self.ego_poses
        poses = [self._recent.sweep(k).pose if known is None else known[k] for k in (index, index + 1)]
        return relative_transform(poses[1], poses[0])

    @cached_property
    def _gaps(self) -> np.ndarray:
        """(K-1,) float64 seconds from each sweep to the next."""
        stamp = self._recent.sweep(0).timestamp_ns
        if stamp is None:
            return np.full(len(self) - 1, _INTERVAL)
        unit = 1e-6 if stamp == 1000 * self.timestamps[0] != self.timestamps[0] else 1e-9
        gaps = np.diff(np.array(self.timestamps, np.int64)) * unit
        return np.where(gaps > 0, gaps, _INTERVAL)

    @cached_property
    def _interval(self) -> float:
        """Seconds of one turn."""
        return self.log.unwrapped.turn_seconds or float(np.median(self._gaps))


def has_moved_by_times(log: DeskewedLog) -> bool:
    """Test whether the reader has already moved the points by their times."""
    return log.unwrapped.moves_by_times and log.read(0, "off").point_times is not None


def choose_reading(log: DeskewedLog) -> Reading:
    """Choose how to read the sweeps of a log for deskew=auto.

    Convention:
        - Logs of formats that are known to be compensated stay as they are (`Log.is_compensated`), and so do logs
          without the attribute `poses`.
        - Otherwise, times of points are used if they are known to be those of raw points (`Log.has_raw_times`).
        - If the vehicle moves by more than half a metre a sweep, the static world decides: three pairs of sweeps some
          6 m apart, and the share of the structure of the earlier one that is in place in the later one. If the log has
          times, we compare the readings "times" and "off", otherwise "off" and both directions. We depart from the
          above only for a reading that is better than "off" by 8 %, and better in every pair. With a wrong direction,
          the error of "off" doubles, so "off" must also be better than the other direction, by 3 %. And the share must
          fall by a sixth if we shift the earlier sweep by 15 cm: along smooth walls it does not.
        - Of the starts of a turn, we take the one with the largest share, and the one behind if none is better by 3 %.

    Cost: 0.3 s and up to six sweeps; nothing where the format or the speed decides.
    """
    own = log.unwrapped
    if own.is_compensated or log.ego_poses is None:
        return Reading("off")
    if has_moved_by_times(log):
        return Reading("off")
    has_times = log.read(0, "off").point_times is not None
    expected = "times" if has_times and own.has_raw_times else "off"
    others = ["off" if expected == "times" else "times"] if has_times else list(DIRECTIONS)
    pairs = _choose_pairs(log)
    shares = _shares(log, pairs, [expected, *others])
    best = expected
    if shares:
        ranked = sorted(shares, key=lambda name: float(shares[name].mean()), reverse=True)
        means = [float(shares[name].mean()) for name in ranked]
        found = ranked[0]
        is_ordered = found != expected and ranked[1] == expected and means[0] >= _LIKELY * means[1]
        if is_ordered and found in DIRECTIONS:
            found, shares[ranked[0]] = _best_start(log, pairs, found, shares[found])
        is_ordered &= all(better >= _LIKELY * worse for better, worse in zip(means[1:], means[2:]))
        is_clear = is_ordered and shares[ranked[0]].mean() >= _CLEARLY * means[1]
        if is_clear and (shares[ranked[0]] > shares[expected]).all():
            shifted = _shares(log, pairs, [found], _SHIFT)[found]
            best = found if shares[ranked[0]].mean() > _PEAK * shifted.mean() else expected
    if best == "off" and expected == "off":
        return Reading("off")
    measured = f": {_described(shares)} of the static structure is in place some metres later" if shares else ""
    same = f"data.deskew={best} does the same without this line"
    if best == "off":
        return Reading(
            "off", f"its points have times, but seem to be de-skewed already, so we leave them{measured}. {same}"
        )
    by = "the times of its points" if best == "times" else f"the azimuth ({best}; ahead = the instant)"
    note = f"its sweeps are not de-skewed, so we move each point by the ego motion according to {by}{measured}. {same}"
    return Reading(best, note + ", data.deskew=off leaves the points as they are")


def _best_start(log: DeskewedLog, pairs: Sequence[_Pair], direction: str, behind: np.ndarray) -> tuple[str, np.ndarray]:
    """Return where a turn begins, as the name of the reading, and its shares. `behind` are those of a start behind."""
    shares = _shares(log, pairs, [direction + start for start in STARTS if start])
    best = max(shares, key=lambda name: float(shares[name].mean()))
    is_better = shares[best].mean() >= _LIKELY * behind.mean()
    return (best, shares[best]) if is_better else (direction, behind)


def _described(shares: dict[str, np.ndarray]) -> str:
    return ", ".join(f"{values.mean():.1%} with {name}" for name, values in shares.items())


class _Pair(NamedTuple):
    """Two sweeps some metres apart, as stored, and the rows of their static structure, thinned."""

    indices: tuple[int, int]  # the earlier and the later one
    sweeps: tuple[Sweep, Sweep]
    rows: tuple[np.ndarray, np.ndarray]


def _choose_pairs(log: DeskewedLog) -> list[_Pair]:
    """Read three pairs of sweeps about 6 m apart; [] if the vehicle is too slow, or too little structure is in view."""
    poses: Any = log.ego_poses
    motion = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    is_fast = motion > _LEAST_MOTION
    if not is_fast.any():
        return []
    distance = int(np.clip(round(_BASELINE / float(np.median(motion[is_fast]))), 1, _MOST_SWEEPS))
    distance = min(distance, len(log) - 1)
    starts = np.flatnonzero(is_fast[: len(log) - distance])
    if not len(starts):
        return []
    chosen = np.unique(starts[np.linspace(0, len(starts) - 1, _PAIRS).round().astype(int)])
    pairs = []
    for earlier in chosen.tolist():
        indices = earlier, earlier + distance
        sweeps = log.read(indices[0], "off"), log.read(indices[1], "off")
        source, target = (_thinned_structure(sweep) for sweep in sweeps)
        if min(len(source), len(target)) >= _FEWEST_POINTS:
            source = source[np.random.default_rng(0).permutation(len(source))[:_MOST_POINTS]]
            pairs.append(_Pair(indices, sweeps, (source, target)))
    return pairs


def _thinned_structure(sweep: Sweep) -> np.ndarray:
    static = static_rows(sweep)
    return static[thinned_rows(as_numpy(sweep.points)[static, :3])]


def _shares(
    log: DeskewedLog, pairs: Sequence[_Pair], readings: Sequence[str], shift: float = 0.0
) -> dict[str, np.ndarray]:
    """Return the share of static structure in place in each pair, by reading; {} without pairs.

    The earlier sweep of each pair is moved by `shift` metres along the path.
    """
    shares: dict[str, list[float]] = {name: [] for name in readings if pairs}
    for pair in pairs:
        T_later_earlier = relative_transform(pair.sweeps[1].pose, pair.sweeps[0].pose)
        T_later_earlier[:3, 3] *= 1 + shift / float(np.linalg.norm(T_later_earlier[:3, 3]))
        for reading, of_pairs in shares.items():
            clouds = []
            for sweep, rows, index in zip(pair.sweeps, pair.rows, pair.indices):
                points = as_numpy(sweep.points)[rows, :3]
                if reading != "off":
                    points = log.move(points, log.seconds(sweep, reading, rows), index, reading)
                clouds.append(points)
            of_pairs.append(share_in_place(clouds[0], clouds[1], T_later_earlier))
    return {name: np.array(of_pairs) for name, of_pairs in shares.items()}
