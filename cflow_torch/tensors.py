"""Read points, masks and times of sweeps as tensors on one device."""

from __future__ import annotations

import math
from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.types import Array, CFlowError, Sweep, Window

_ALL_ROWS = slice(None)
# Largest time of a point, seconds from the instant of its sweep. Larger numbers have another unit.
_LONGEST_TIME = 10.0
# We round times of points to this fraction of a sweep interval, so that their sums are exact in any order.
_TICKS = 1 << 20


def choose_device(windows: Sequence[Window], device: Any) -> torch.device:
    """Return the given device. For "auto": the device of the tensors, else a GPU if there is one, else the CPU."""
    if not (isinstance(device, str) and device == "auto"):
        try:
            torch.empty(0, device=device)
            chosen = torch.device(device)
        except (RuntimeError, TypeError, AssertionError) as error:
            reason = str(error).splitlines()[0]
            raise CFlowError(f"device={device!r} cannot be used ({reason}): give 'auto', 'cpu' or 'cuda'") from None
    else:
        sweeps = [sweep for window in windows for sweep in window.sweeps]
        arrays = [array for sweep in sweeps for array in (sweep.points, sweep.is_ground, sweep.point_times)]
        found = {array.device for array in arrays if isinstance(array, Tensor)}
        if len(found) > 1:
            names = ", ".join(sorted(str(d) for d in found))
            raise CFlowError(f"tensors are on different devices ({names}): move them to one, or pass device=...")
        chosen = found.pop() if found else torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if chosen.type == "meta":
        raise CFlowError("the device 'meta' holds no numbers: give tensors with values, and 'auto', 'cpu' or 'cuda'")
    return chosen


def read_positions(sweeps: Sequence[Sweep], device: torch.device, rows: slice = _ALL_ROWS) -> Tensor:
    """Return a copy of x, y and z of some rows of each sweep, one sweep after the other, (3, N) float64."""
    columns = [sweep.points[rows, :3].T for sweep in sweeps]
    if len(columns) == 1 and isinstance(columns[0], Tensor):
        # copy_ transposes and widens in one pass, about six times faster on the CPU than contiguous().
        return torch.empty(columns[0].shape, dtype=torch.float64, device=device).copy_(columns[0].detach())
    # A GPU receives float32 if no array is wider. NumPy converts to native byte order, too.
    widths = [values.dtype.itemsize for values in columns if not isinstance(values, Tensor)]
    narrow = device.type != "cpu" and max(widths, default=0) <= 4
    return _together(columns, np.float32 if narrow else np.float64, device).double()


def read_ground(sweeps: Sequence[Sweep], device: torch.device) -> Tensor:
    """Return a copy of the ground masks, one sweep after the other, (N,) bool; False in sweeps without a mask."""
    masks = [np.zeros(len(sweep.points), bool) if sweep.is_ground is None else sweep.is_ground for sweep in sweeps]
    return _together(masks, np.bool_, device)


def _together(columns: Sequence[Array], dtype: Any, device: torch.device) -> Tensor:
    """Concatenate (..., N) arrays or tensors on the device. Arrays share an upload, as the host waits for each."""
    if not any(isinstance(values, Tensor) for values in columns):
        shape = (*columns[0].shape[:-1], sum(values.shape[-1] for values in columns))
        return torch.from_numpy(np.concatenate(columns, -1, out=np.empty(shape, dtype))).to(device)
    given = [values if isinstance(values, Tensor) else torch.from_numpy(np.array(values, dtype)) for values in columns]
    return torch.cat([values.detach().to(device) for values in given], -1)


def read_point_times(sweep: Sweep, name: str, interval: float | None, device: torch.device) -> Tensor:
    """Return the times of the points, (N,) float64, in sweep intervals, rounded to multiples of 2^-20.

    `interval` is the time from t to t+1 in seconds; None = times are not used, and the result is 0. Times that are not
    finite, or more than 10 s from the time stamp, are a `CFlowError` with the `name` of the sweep.
    """
    if interval is None:
        return torch.zeros(sweep.points.shape[0], dtype=torch.float64, device=device)
    times = float64_tensor(sweep.point_times, device)
    if not bool((times.abs() <= _LONGEST_TIME).all()):  # False for NaN
        raise CFlowError(
            f"point times of {name} are not all finite and within {_LONGEST_TIME:g} s of 0: give seconds after the "
            "sweep's time stamp (nanoseconds / 1e9, not a time of day)"
        )
    # A GPU multiplies by the reciprocal of a plain number, which rounds differently.
    times = times / times.new_full((1,), interval)
    return torch.floor(times * _TICKS + 0.5) / _TICKS


def float64_tensor(values: Any, device: torch.device) -> Tensor:
    """Return values as float64 on a device; arrays of any dtype, byte order and strides are copied."""
    given = values.detach() if isinstance(values, Tensor) else torch.from_numpy(np.array(values, dtype=np.float64))
    return given.to(device, torch.float64)


def resolution(dtype: Any, distance: float) -> float:
    """Return the step between neighbouring numbers of a dtype at a distance from 0. It is 0 for integer dtypes."""
    if isinstance(dtype, torch.dtype):
        epsilon = torch.finfo(dtype).eps if dtype.is_floating_point else 0.0
    else:
        epsilon = float(np.finfo(dtype).eps) if np.issubdtype(dtype, np.floating) else 0.0
    return math.ldexp(epsilon, math.frexp(distance)[1] - 1) if distance else 0.0
