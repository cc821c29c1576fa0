"""Checks of what users give: shapes, dtypes, devices, repeated sweeps, time stamps."""

from __future__ import annotations

import logging
import math
from contextlib import suppress
from dataclasses import replace
from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.types import CFlowError, Sweep, Window, as_numpy

# No sweep of a window is further away than this, metres: 2 s at 50 m/s.
_FARTHEST_POSE = 100.0
# Sweeps that differ at all differ in their first points: those are compared before the whole clouds are.
_FIRST_POINTS = 64
_ALL_ROWS = slice(None)
# No sweep has so many columns; three or four rows of them are coordinates of that many points.
_MOST_COLUMNS = 1000
_log = logging.getLogger(__name__)


def check_windows(windows: Any, config: Config | None = None) -> None:
    """Refuse what is not a list of windows of sweeps of arrays.

    Args:
        windows: anything.
        config: settings whose region and finest pixels the points must be fine enough for; None = not looked at.

    Raises:
        CFlowError: what is wrong, by the name that users know it by.
    """
    if isinstance(windows, (Window, Sweep)) or not isinstance(windows, (list, tuple)):
        raise CFlowError(f"got {type(windows).__name__}: give a list of cflow_torch.Window, also for one window")
    for window in windows:
        if not isinstance(window, Window):
            raise CFlowError(f"the list holds {type(window).__name__}: give cflow_torch.Window(pc0=Sweep(...), ...)")
        for name, others in (("pch", window.pch), ("pcf", window.pcf)):
            if not isinstance(others, (list, tuple)):
                raise CFlowError(f"{name} is {type(others).__name__}: give a tuple of cflow_torch.Sweep, () for none")
        for name, sweep in _named_sweeps(window):
            if not isinstance(sweep, Sweep):
                raise CFlowError(f"{name} is {type(sweep).__name__}: give cflow_torch.Sweep(points, ...)")
            check_points(sweep.points, name)
            if sweep.point_times is not None:
                _check_point_times(sweep, name)
            if config is not None:
                _check_resolution(sweep.points.dtype, name, config)


def keep_nearest(window: Window, num_history: int) -> Window:
    """The window with so many older sweeps at most, the nearest ones; a note is logged if that leaves some out."""
    if len(window.pch) <= num_history:
        return window
    _log.info("of %d history sweeps the nearest %d are used (num_history)", len(window.pch), num_history)
    return replace(window, pch=window.pch[:num_history])


def source_sweeps(window: Window, config: Config) -> list[tuple[str, Sweep, int]]:
    """(name, sweep, steps to t+1) of pc0, the history and what comes after t+1, repeated sweeps left out.

    Steps are 1 for pc0, 2, 3, ... for the history, and -1, -2, ... for t+2, t+3, ..., which stand last.
    """
    if len(window.pcf) > config.num_future:
        raise CFlowError(
            f"the window has {len(window.pcf)} future sweeps but num_future={config.num_future}: pass num_future, or "
            "fewer sweeps"
        )
    sweeps = [window.pc1, window.pc0, *window.pch, *window.pcf]
    with_pose = [sweep.pose is not None for sweep in sweeps]
    if any(with_pose) and not all(with_pose):
        raise CFlowError(
            "some sweeps of the window have a pose and some have none: give the pose of every sweep, or of none "
            "(then all points must already lie in the frame of t+1)"
        )
    sources: list[tuple[str, Sweep, int]] = []
    num_past = 1 + len(window.pch)
    for step, (name, sweep) in enumerate(_named_sweeps(window)[1:], 1):
        is_future = step > num_past
        repeats = any(_same(sweep, other) for _, other, _ in sources) or (is_future and _same(sweep, window.pc1))
        if not repeats:
            sources.append((name, sweep, num_past - step if is_future else step))
    return sources


def _named_sweeps(window: Window) -> list[tuple[str, Sweep]]:
    """Every sweep under its name: t+1, then t, t-1, ... from newest to oldest, then t+2, t+3, ..."""
    others = [(f"pc{side}{i}", sweep) for side in "hf" for i, sweep in enumerate(getattr(window, f"pc{side}"), 1)]
    return [("pc1", window.pc1), ("pc0", window.pc0), *others]


def check_points(points: Any, name: str) -> None:
    """Refuse what is not (N, 3+) floats."""
    if not isinstance(points, (np.ndarray, Tensor)):
        raise CFlowError(f"{name} is {type(points).__name__}: give a NumPy array or a torch tensor of shape (N, 3+)")
    check_plain(points, name)
    if points.ndim != 2 or points.shape[1] < 3:
        raise CFlowError(f"{name} has shape {tuple(points.shape)}: give (N, 3+), columns x, y, z in metres")
    if points.shape[1] > _MOST_COLUMNS:
        raise CFlowError(f"{name} has shape {tuple(points.shape)}: a row is a point; give its transpose, (N, 3+)")
    is_floating = points.is_floating_point() if isinstance(points, Tensor) else np.issubdtype(points.dtype, np.floating)
    if not is_floating:
        raise CFlowError(f"{name} has dtype {points.dtype}: give floating-point metres")


def _check_point_times(sweep: Sweep, name: str) -> None:
    """Refuse what is not a float for each point; their values are looked at when they are read."""
    times, wanted = sweep.point_times, f"give ({sweep.points.shape[0]},) floats, seconds after the sweep's time stamp"
    if not isinstance(times, (np.ndarray, Tensor)):
        raise CFlowError(f"point times of {name} are {type(times).__name__}: {wanted}")
    check_plain(times, f"point times of {name}")
    is_floating = times.is_floating_point() if isinstance(times, Tensor) else np.issubdtype(times.dtype, np.floating)
    if tuple(times.shape) != (sweep.points.shape[0],) or not is_floating:
        raise CFlowError(f"point times of {name} have shape {tuple(times.shape)} and dtype {times.dtype}: {wanted}")


def resolution(dtype: Any, distance: float) -> float:
    """Difference between neighbouring numbers of a type at a distance from 0, in its unit; 0 for whole numbers."""
    if isinstance(dtype, torch.dtype):
        epsilon = torch.finfo(dtype).eps if dtype.is_floating_point else 0.0
    else:
        epsilon = float(np.finfo(dtype).eps) if np.issubdtype(dtype, np.floating) else 0.0
    return math.ldexp(epsilon, math.frexp(distance)[1] - 1) if distance else 0.0


def _check_resolution(dtype: Any, name: str, config: Config) -> None:
    """Refuse points of a type that is coarser than half of the finest pixels at the far end of the region."""
    bounds, pixel_size = config.point_cloud_range, config.pixel_sizes[-1]
    farthest = max(abs(bound) for bound in (*bounds[:2], *bounds[3:5]))
    step = resolution(dtype, farthest)
    if step > 0.5 * pixel_size:
        raise CFlowError(
            f"{name} is {dtype}, which at {farthest:g} m (the far end of point_cloud_range) only holds multiples of "
            f"{step:g} m, too coarse for pixels of {pixel_size:g} m: give points of a wider type, or a frame whose "
            "origin is nearer (point_cloud_range and poses with it), or larger pixel_sizes"
        )


def check_plain(array: Any, name: str) -> None:
    """Refuse arrays that hold something else than they seem to."""
    if isinstance(array, Tensor) and array.layout != torch.strided:
        raise CFlowError(f"{name} has layout {array.layout}: give a dense tensor")
    if isinstance(array, np.ma.MaskedArray):
        raise CFlowError(f"{name} is a masked array, whose mask would be lost: give .filled(...), of points with NaN")


def _same(a: Sweep, b: Sweep) -> bool:
    """Same points and same pose: harnesses repeat the first sweep of a scene where history is missing."""
    if a is b:
        return True
    if a.points.shape != b.points.shape or (a.pose is None) != (b.pose is None):
        return False
    if a.pose is not None and b.pose is not None and not np.array_equal(as_numpy(a.pose), as_numpy(b.pose)):
        return False
    parts = (slice(_FIRST_POINTS), slice(None))
    return all(np.array_equal(as_numpy(a.points[rows]), as_numpy(b.points[rows]), equal_nan=True) for rows in parts)


def elapsed_times(
    window: Window, sources: Sequence[tuple[str, Sweep, int]], config: Config
) -> Sequence[tuple[float, float]]:
    """(sweep intervals, seconds) from each source sweep to t+1, by time stamps where every sweep has one.

    Both are negative for sweeps after t+1.
    """
    if any(sweep.timestamp_ns is None for _, sweep in _named_sweeps(window)):
        return [(float(step), step * config.sweep_interval) for _, _, step in sources]
    newest = _nanoseconds(window.pc1, "pc1")
    gaps = [newest - _nanoseconds(sweep, name) for name, sweep, _ in sources]
    before, after = ([way * gap for gap, (_, _, step) in zip(gaps, sources) if way * step > 0] for way in (1, -1))
    if min(later - earlier for side in (before, after) for earlier, later in zip([0, *side], side)) <= 0:
        raise CFlowError(
            f"time stamps of the window are out of order (nanoseconds before t+1: {gaps}): "
            "give pc1, pc0, pch1, ... from newest to oldest, and pcf1, ... after pc1 from oldest to newest"
        )
    return [(gap / gaps[0], gap / 1e9) for gap in gaps]


def _nanoseconds(sweep: Sweep, name: str) -> int:
    """The time stamp of a sweep that has one."""
    with suppress(TypeError, ValueError, OverflowError, RuntimeError):
        stamp = int(sweep.timestamp_ns)  # type: ignore[arg-type]
        if abs(stamp) < 1 << 63:
            return stamp
    raise CFlowError(
        f"timestamp_ns of {name} is {sweep.timestamp_ns!r}: give whole nanoseconds that fit an int64, or None for "
        "every sweep of the window"
    )


def check_distance(T_ego1_ego: np.ndarray, name: str) -> None:
    """Refuse a sweep whose ego vehicle is implausibly far from that at t+1.

    Raises:
        CFlowError: further than `_FARTHEST_POSE`.
    """
    distance = float(np.linalg.norm(T_ego1_ego[:3, 3]))
    if distance > _FARTHEST_POSE:
        raise CFlowError(
            f"the ego vehicle moves {distance:.0f} m between {name} and pc1 (at most {_FARTHEST_POSE:.0f} m): "
            "are the poses of another log, or not in metres?"
        )


def choose_device(windows: Sequence[Window], device: Any) -> torch.device:
    """The device asked for; for "auto" that of the tensors given, else a GPU if there is one, else the CPU.

    Raises:
        CFlowError: a device that cannot be used, or tensors on several devices.
    """
    if not (isinstance(device, str) and device == "auto"):
        try:
            torch.empty(0, device=device)
            chosen = torch.device(device)
        except (RuntimeError, TypeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise CFlowError(f"device={device!r} cannot be used ({reason}): give 'auto', 'cpu' or 'cuda'") from None
    else:
        arrays = [
            a
            for window in windows
            for _, sweep in _named_sweeps(window)
            for a in (sweep.points, sweep.is_ground, sweep.point_times)
        ]
        found = {array.device for array in arrays if isinstance(array, Tensor)}
        if len(found) > 1:
            names = ", ".join(sorted(str(d) for d in found))
            raise CFlowError(f"tensors lie on different devices ({names}): put them on one, or pass device=...")
        chosen = found.pop() if found else torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if chosen.type == "meta":
        raise CFlowError("the device 'meta' holds no numbers: give tensors with values, and 'auto', 'cpu' or 'cuda'")
    return chosen


def read_positions(sweep: Sweep, device: torch.device, rows: slice = _ALL_ROWS) -> Tensor:
    """(3, N) float64 copy of the first three columns of some rows; the input is never modified."""
    if not isinstance(sweep.points, Tensor) and device.type == "cpu":
        return torch.from_numpy(np.array(sweep.points[rows, :3].T, dtype=np.float64, order="C"))
    return join_positions([sweep], device, rows)


def join_positions(sweeps: Sequence[Sweep], device: torch.device, rows: slice = _ALL_ROWS) -> Tensor:
    """(3, N) float64, those of several sweeps, one behind the other."""
    parts = []
    for sweep in sweeps:
        columns = sweep.points[rows, :3]
        if not isinstance(columns, Tensor):
            # What travels is as narrow as what was given, and in native byte order.
            narrow = np.float32 if columns.dtype.itemsize <= 4 else np.float64
            columns = torch.from_numpy(np.array(columns, dtype=narrow))
        parts.append(columns.detach().to(device))
    columns = parts[0] if len(parts) == 1 else torch.cat(parts)
    # copy_ turns and widens in one pass, about six times faster on the CPU than t().contiguous().
    positions = torch.empty((3, len(columns)), dtype=torch.float64, device=device)
    return positions.copy_(columns.t())


def read_ground(sweep: Sweep, name: str, num_points: int, device: torch.device) -> Tensor:
    """(N,) bool ground mask, True = ground; the sweep must have one.

    Raises:
        CFlowError: no bool array or tensor of one entry per point.
    """
    mask = sweep.is_ground
    if not isinstance(mask, (np.ndarray, Tensor)):
        raise CFlowError(f"ground mask of {name} is {type(mask).__name__}: give a bool array or tensor of shape (N,)")
    if tuple(mask.shape) != (num_points,):
        raise CFlowError(f"ground mask of {name} has shape {tuple(mask.shape)}: give ({num_points},), one per point")
    if mask.dtype not in (torch.bool, np.bool_):
        raise CFlowError(f"ground mask of {name} has dtype {mask.dtype}: give bool, True = ground")
    check_plain(mask, f"ground mask of {name}")
    if isinstance(mask, np.ndarray):
        mask = torch.from_numpy(np.array(mask))
    return mask.to(device)
