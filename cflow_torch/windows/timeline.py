"""List the sweeps of a batch in order, with their steps, times and transforms."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Iterator, NamedTuple, Sequence

import numpy as np

from cflow_torch.config import Config
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import CFlowError, Sweep, Window, as_numpy, named_sweeps
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.validation import have_same_points

# Largest plausible distance of an ego position from the one at t+1, metres: 2 s at 50 m/s.
_FARTHEST_POSE = 100.0


class SourceSweep(NamedTuple):
    """A sweep other than t+1 from which we estimate the flow."""

    name: str  # for errors: "pc0", "pch1", ...
    sweep: Sweep
    # Sweep intervals from the sweep to t+1, by its place in the window: 1 for t, 2 for t-1, ..., -1 for t+2, -2 for
    # t+3, ...
    intervals: int


class Entry(NamedTuple):
    """One sweep of one window."""

    step: int  # 0 = t+1, 1 = t, 2 = t-1 or t+2, ...
    window: int  # index of the window in the batch
    name: str  # for errors: "pc1", "pc0", "pch1", ...
    sweep: Sweep
    T_ego1_ego: np.ndarray | None  # (4, 4) float64; None = the points are in the frame of t+1
    interval: float | None  # seconds from t to t+1; None = times of points are not used


@dataclass(frozen=True)
class Timeline:
    """All sweeps of a batch: t+1 of every window, then t of every window, then t-1, ..."""

    entries: list[Entry]
    table: np.ndarray  # (5, B, S) float64: `elapsed`, `seconds` and x, y, z of `origin`, as in `Batch`

    @staticmethod
    def of(windows: Sequence[Window], config: Config, grid: Grid, needs_times: bool) -> Timeline:
        """Check everything but the points, and list the sweeps. Arguments and errors as in `make_batch`."""
        sources = [source_sweeps(window, config) for window in windows]
        sides = [_side(of_window, is_past=True) for of_window in sources]
        if config.num_future > 0:
            sides += [_side(of_window, is_past=False) for of_window in sources]
        sides = [_compared(side, config.num_compared) for side in sides]
        table = np.zeros((5, len(sides), 1 + max(map(len, sides))))
        farthest = max(map(abs, (*grid.lower[:2], *grid.upper[:2])))
        entries: list[Entry] = []
        for index, side in enumerate(sides):
            number = index % len(windows)
            times = elapsed_times(windows[number], side, config.sweep_interval)
            table[:2, index, 1 : 1 + len(side)] = np.transpose(times)
            # If one sweep lacks times of points, de-skewing the others would shift them against it.
            sweeps = [windows[number].pc1, *(source.sweep for source in sources[number])]
            has_times = needs_times and all(sweep.point_times is not None for sweep in sweeps)
            interval = times[0][1] / times[0][0] if has_times else None
            for entry in _entries(windows[number], index, side, interval, farthest):
                if entry.T_ego1_ego is not None:
                    table[2:, index, entry.step] = entry.T_ego1_ego[:3, 3]
                entries.append(entry)
        return Timeline(sorted(entries, key=lambda entry: entry.step), table)


def _side(sources: Sequence[SourceSweep], is_past: bool) -> list[SourceSweep]:
    """List the sweeps of one side of t+1. The future side has t, too, first."""
    if is_past:
        return [source for source in sources if source.intervals > 0]
    return [sources[0], *(source for source in sources if source.intervals < 0)]


def _compared(side: list[SourceSweep], count: int | None) -> list[SourceSweep]:
    """Keep t, and of the other sweeps of a side `count`: the farthest, the nearest, and others evenly between them.

    A motion of several intervals is longer, so the farthest sweep shows slow objects best. None = keep all.
    """
    sweep_t, *others = side
    if count is None or len(others) <= count:
        return side
    last = len(others) - 1
    steps_back = [number * last // max(count - 1, 1) for number in range(count)]
    return [sweep_t, *(others[last - step] for step in reversed(steps_back))]


def _entries(
    window: Window, index: int, sources: Sequence[SourceSweep], interval: float | None, farthest: float
) -> Iterator[Entry]:
    """Yield t+1 and the other sweeps of one side of a window, with their transforms to t+1."""
    yield Entry(0, index, "pc1", window.pc1, None, interval)
    T_ego1_world = None
    if window.pc1.pose is not None:
        T_ego1_world = np.linalg.inv(rigid_transform(window.pc1.pose, "pose1", farthest))
    for step, (name, sweep, _) in enumerate(sources, 1):
        T_ego1_ego = None
        if T_ego1_world is not None:
            T_ego1_ego = T_ego1_world @ rigid_transform(sweep.pose, f"pose of {name}", farthest)
            _check_distance(T_ego1_ego, name)
        yield Entry(step, index, name, sweep, T_ego1_ego, interval)


def source_sweeps(window: Window, config: Config) -> list[SourceSweep]:
    """List pc0, the history, then the sweeps after t+1.

    We skip repeats of a listed sweep and, after t+1, of pc1. Older and later sweeps without points are skipped, too,
    because they do not tell that a place is empty.
    """
    if len(window.pcf) > config.num_future:
        raise CFlowError(
            f"the window has {len(window.pcf)} future sweeps but num_future={config.num_future}: raise num_future, or "
            "pass fewer sweeps"
        )
    has_pose = [sweep.pose is not None for sweep in window.sweeps]
    if any(has_pose) and not all(has_pose):
        raise CFlowError(
            "some sweeps of the window have a pose and some do not: give the pose of every sweep, or of none "
            "(then all points must already be in the frame of t+1)"
        )
    sources: list[SourceSweep] = []
    num_past = 1 + len(window.pch)
    for step, (name, sweep) in enumerate(named_sweeps(window)[1:], 1):
        is_future = step > num_past
        earlier = [source.sweep for source in sources] + ([window.pc1] if is_future else [])
        is_empty = step > 1 and sweep.points.shape[0] == 0
        if not is_empty and not any(_is_same(sweep, other) for other in earlier):
            sources.append(SourceSweep(name, sweep, num_past - step if is_future else step))
    return sources


def _is_same(a: Sweep, b: Sweep) -> bool:
    """Test whether points and poses are equal. Harnesses fill a missing history with the first sweep of the scene."""
    if a is b:
        return True
    if a.pose is not None and b.pose is not None and not np.array_equal(as_numpy(a.pose), as_numpy(b.pose)):
        return False
    return have_same_points(a, b)


def elapsed_times(window: Window, sources: Sequence[SourceSweep], sweep_interval: float) -> list[tuple[float, float]]:
    """Return the time from each source to t+1 in sweep intervals and in seconds, negative for sources after t+1.

    The first source is t. We take the time from the time stamps if all sweeps of the window have one, otherwise from
    `sweep_interval`, seconds.
    """
    if any(sweep.timestamp_ns is None for sweep in window.sweeps):
        return [(float(source.intervals), source.intervals * sweep_interval) for source in sources]
    newest = _nanoseconds(window.pc1, "pc1")
    gaps = [newest - _nanoseconds(source.sweep, source.name) for source in sources]
    past, future = ([sign * gap for gap, s in zip(gaps, sources) if sign * s.intervals > 0] for sign in (1, -1))
    if min(later - earlier for gaps_of in (past, future) for earlier, later in zip([0, *gaps_of], gaps_of)) <= 0:
        raise CFlowError(
            f"time stamps of the window are out of order (nanoseconds before t+1: {gaps}): "
            "give pc1, pc0, pch1, ... from newest to oldest, and pcf1, ... after pc1 from oldest to newest"
        )
    return [(gap / gaps[0], gap / 1e9) for gap in gaps]


def _nanoseconds(sweep: Sweep, name: str) -> int:
    with suppress(TypeError, ValueError, OverflowError, RuntimeError):
        stamp = int(sweep.timestamp_ns)  # type: ignore[arg-type]
        if abs(stamp) < 1 << 63 and stamp == sweep.timestamp_ns:  # 0.1 is in seconds
            return stamp
    raise CFlowError(
        f"timestamp_ns of {name} is {sweep.timestamp_ns!r}: give whole nanoseconds that fit an int64, or None for "
        "every sweep of the window"
    )


def _check_distance(T_ego1_ego: np.ndarray, name: str) -> None:
    distance = float(np.linalg.norm(T_ego1_ego[:3, 3]))
    if distance > _FARTHEST_POSE:
        raise CFlowError(
            f"the ego vehicle moves {distance:.0f} m between {name} and pc1 (at most {_FARTHEST_POSE:.0f} m): "
            "are the poses from another log, or not in metres?"
        )
