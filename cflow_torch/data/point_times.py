"""Times of points as LiDAR drivers store them: any unit, any clock, counters that wrapped, and stray values."""

from __future__ import annotations

from typing import Any, Callable, Mapping, NamedTuple

import numpy as np

from cflow_torch.data.column_names import time_columns

_UNITS = (10**9, 10**6, 10**3, 1)  # nanoseconds in s, ms, us and ns
# Seconds in which the middle half of the points is measured. The range is below a factor of 1000, so one unit fits.
_SHORTEST_HALF, _LONGEST_HALF = 0.0015, 1.4
_USUAL_PERIOD, _LONGEST_PERIOD = 0.1, 0.25  # seconds between sweeps; a log with more is thinned
_LARGEST_LAG = 1.5  # periods from the stamp of a sweep to its nearest point; more means another clock
_REPEATED = 0.01  # a single time of more points than this share is a default value, if no other time has many points
_MOST_STRAY = 0.2  # share of the points with stray values besides one; with more, the column holds other numbers
_LATEST = 2.0**64  # integers that fit; larger floats are no times in any unit
_COARSE = 8  # steps of a float in that half; with fewer, the type cannot hold the times


class PointTimes(NamedTuple):
    """Times of the points of one sweep."""

    # (N,) float64 seconds after the stamp of the sweep, of stray values any within a sweep; None = these are not times.
    seconds: np.ndarray | None
    is_stray: np.ndarray  # (N,) bool, True = this value is far from all others, so the time of the point is unknown
    note: str  # what we assumed, or why there are no times; "" = nothing to say


def find_times(
    columns: Mapping[str, np.ndarray],
    stamp_ns: int | None,
    period: float | None,
    tell: Callable[[str, str], None],
    is_missing: np.ndarray | None = None,
) -> PointTimes | None:
    """Return the times in the columns of a cloud, by the first usable one; None = there are none.

    `tell` is called with what we assume or leave out, and the kind of this text. Other arguments: `seconds_after`.
    """
    found = [seconds_after(columns[name], stamp_ns, period, is_missing) for name in time_columns(columns)]
    usable = [times for times in found if times.seconds is not None]
    for times in usable[:1] or found:
        tell(times.note, "times of points")
    if not usable:
        return None
    is_stray = usable[0].is_stray
    if is_stray.any():
        text = f"{is_stray.sum()} of {len(is_stray)} points of a sweep have stray times and are left out"
        tell(text + ", also in other sweeps", "stray times")
    return usable[0]


def seconds_after(
    values: np.ndarray,
    stamp_ns: int | None,
    period: float | None = None,
    is_missing: np.ndarray | None = None,
) -> PointTimes:
    """Convert times of any unit and clock to seconds after the stamp of their sweep.

    Args:
        values: (N,) integers or floats.
        stamp_ns: time of the sweep, nanoseconds; None = unknown.
        period: seconds between the sweeps of the log; None = unknown.
        is_missing: (N,) bool, rows that are no returns, so their values mean nothing; None = there are none.

    Convention:
        - Integers that wrapped go on: we take differences from the median modulo the range of their type.
        - Stray values are not finite, or farther from the median than a sweep lasts, or one value that more than 1 % of
          the points share (drivers write 0 for lost packets). If more than a fifth of the points have such values
          besides the most frequent one, these are not times.
        - The unit is the one of s, ms, us and ns in which a sweep has a plausible duration. Floats that fill the range
          from 0 to 1 are shares of a sweep.
        - Times count from the stamp or, if that is clearly closer to the stamp, from the epoch of the stamp. If neither
          is within one and a half periods of the stamp, the times have another clock. Then the first point is at the
          stamp.
    """
    nothing = np.zeros(len(values), bool)
    missing = nothing if is_missing is None else is_missing
    is_given = ~missing & np.isfinite(values)
    given = np.where(is_given, values, values.dtype.type(0))  # computing with signalling NaN warns
    is_stray = ~is_given | (np.abs(given.astype(np.float64)) > _LATEST)
    is_stray[is_given] |= _is_default(given[is_given])
    if is_stray.all():
        return PointTimes(None, nothing, "" if missing.all() else "no time of a point is finite")
    times = _converted(given, is_stray, stamp_ns, period)
    if times.seconds is None:
        return times
    times = times._replace(is_stray=times.is_stray & ~missing)
    stray = values[times.is_stray]
    bits = stray.view(f"u{stray.dtype.itemsize}")  # comparing signalling NaN warns
    _, counts = np.unique(bits, return_counts=True)
    num_returns = int((~missing).sum())
    if len(stray) - counts.max(initial=0) > _MOST_STRAY * num_returns:  # the most frequent one is of lost packets
        share = f"{100 * len(stray) / num_returns:.0f} % of the times of points"
        return PointTimes(None, nothing, f"{share} are stray: ignored")
    return times


def _converted(values: np.ndarray, is_stray: np.ndarray, stamp_ns: int | None, period: float | None) -> PointTimes:
    """Convert times by their unit and clock, see `seconds_after`. Times far from the median become stray, too."""
    known = values[~is_stray]
    centre = np.partition(known, len(known) // 2)[len(known) // 2]
    if values.dtype.kind == "f":
        ticks = values.astype(np.float64) - float(centre)
    else:  # counters wrap as in their own type
        ticks = (values - centre).view(f"i{values.dtype.itemsize}").astype(np.float64)
    half = float(np.subtract(*np.quantile(ticks[~is_stray], (0.75, 0.25))))
    if known.dtype.kind == "f" and 0 <= known.min() <= 0.1 and 0.9 <= known.max() <= 1:
        duration = period if period is not None and period <= _LONGEST_PERIOD else _USUAL_PERIOD
        note = f"times of points go from 0 to 1, so we take them for shares of a sweep of {duration:.3g} s"
        return PointTimes(np.where(is_stray, 0.0, values) * duration, is_stray, note)
    if values.dtype.kind == "f" and abs(centre) > 1 and half < _COARSE * np.spacing(abs(centre)):
        note = f"times of points near {centre:.10g} are too coarse in {values.dtype}: ignored"
        return PointTimes(None, np.zeros_like(is_stray), note)
    longest = min(max(0.8 * (period or 0), 1.5 * _USUAL_PERIOD), _LONGEST_HALF)
    unit = next((unit for unit in _UNITS if _SHORTEST_HALF <= half * unit * 1e-9 <= longest), None)
    if unit is None:
        why = "are all equal" if half == 0 else f"span about {2 * half:.4g}, which is not a sweep in s, ms, us or ns"
        return PointTimes(None, np.zeros_like(is_stray), f"times of points {why}: ignored")
    seconds = ticks * (unit * 1e-9)
    usual_period = min(period or _LONGEST_PERIOD, _LONGEST_PERIOD)
    is_stray = is_stray | ~(np.abs(seconds) <= max(1.1 * usual_period, 3e-9 * half * unit))
    lag = _lag(centre, unit, stamp_ns or 0) * 1e-9
    first, last = seconds[~is_stray].min(), seconds[~is_stray].max()
    note = ""
    if lag + last < -_LARGEST_LAG * usual_period or lag + first > _LARGEST_LAG * usual_period:
        if stamp_ns is not None:
            note = f"times of points have another clock than the sweeps ({lag:+.6g} s), so the first is at the stamp"
        lag = -float(first)
    return PointTimes(np.where(is_stray, 0.0, seconds) + lag, is_stray, note)


def _is_default(values: np.ndarray) -> np.ndarray:
    """Test whether each value is the one that more than 1 % of the points have, and no other value comes close."""
    distinct, counts = np.unique(values, return_counts=True)
    most = np.sort(counts)[-2:]
    if len(counts) < 3 or most[1] <= max(_REPEATED * len(values), 4 * most[0]):
        return np.zeros(len(values), bool)
    is_default: np.ndarray = values == distinct[counts.argmax()]
    return is_default


def _lag(centre: Any, unit: int, stamp_ns: int) -> int:
    """Return the nanoseconds from the stamp to the median, under the most plausible origin of times."""
    is_float = centre.dtype.kind == "f"
    time = round(float(centre) * unit) if is_float else int(centre) * unit
    wrapped = time - (unit << 8 * centre.dtype.itemsize)
    after = time if centre.dtype.kind != "u" else min(time, wrapped, key=abs)
    since_epoch = time - stamp_ns
    return since_epoch if 2 * abs(since_epoch) < abs(after) else after
