"""Check the types and the point resolution of windows."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from cflow_torch.config import Config
from cflow_torch.tensors import resolution
from cflow_torch.types import CFlowError, Sweep, Window, as_numpy, named_sweeps

_FIRST_POINTS = 64
_log = logging.getLogger(__name__)


def check_windows(windows: Any, config: Config) -> None:
    """Check that this is a list of windows, and that the dtypes of points resolve the finest pixels in the region."""
    if isinstance(windows, (Window, Sweep)) or not isinstance(windows, (list, tuple)):
        raise CFlowError(f"got {type(windows).__name__}: give a list of cflow_torch.Window, also for one window")
    for window in windows:
        if not isinstance(window, Window):
            raise CFlowError(f"the list holds {type(window).__name__}: give cflow_torch.Window(pc0=Sweep(...), ...)")
        for name, sweep in named_sweeps(window):
            _check_resolution(sweep.points.dtype, name, config)


def keep_nearest(window: Window, num_history: int) -> Window:
    """Keep the newest `num_history` older sweeps of a window, and log if there are more."""
    if len(window.pch) <= num_history:
        return window
    _log.info("of %d history sweeps the nearest %d are used (num_history)", len(window.pch), num_history)
    return replace(window, pch=window.pch[:num_history])


def have_same_points(a: Sweep, b: Sweep) -> bool:
    """Test whether sweeps have the same points. We first compare 64 points, because most sweeps differ there."""
    if a.points.shape != b.points.shape:
        return False
    parts = (slice(_FIRST_POINTS), slice(None))
    return all(np.array_equal(as_numpy(a.points[rows]), as_numpy(b.points[rows]), equal_nan=True) for rows in parts)


def _check_resolution(dtype: Any, name: str, config: Config) -> None:
    """Check that the type resolves half of the finest pixel at the far end of the region."""
    bounds = config.point_cloud_range
    pixel_size = config.pixel_sizes[-1]
    farthest = max(abs(bound) for bound in (*bounds[:2], *bounds[3:5]))
    step = resolution(dtype, farthest)
    if step > 0.5 * pixel_size:
        raise CFlowError(
            f"{name} is {dtype}, which at {farthest:g} m (the far end of point_cloud_range) only holds multiples of "
            f"{step:g} m, too coarse for pixels of {pixel_size:g} m: {_wider(dtype)}, or a frame whose "
            "origin is nearer (point_cloud_range and poses with it), or larger pixel_sizes"
        )


def _wider(dtype: Any) -> str:
    """Say how to write points of a wider type."""
    itemsize = torch.empty(0, dtype=dtype).element_size() if isinstance(dtype, torch.dtype) else dtype.itemsize
    width = "float32" if itemsize < 4 else "float64"
    of_tensor = "points.float()" if itemsize < 4 else "points.double()"
    return f"give {of_tensor if isinstance(dtype, torch.dtype) else f'points.astype(np.{width})'}"
