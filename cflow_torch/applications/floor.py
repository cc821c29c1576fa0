"""The height of the ground below objects, on which their boxes stand."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from cflow_torch.applications.moving_groups import world_points
from cflow_torch.types import Sweep, as_numpy

_CELL = 2.0  # metres; we take the ground points of a cell and of those around it
_FARTHEST = 300.0  # metres, from the vehicle in x and y; a stray return must not make the map huge
_FEWEST_POINTS = 5  # ground points in 3 x 3 cells; with fewer, the height is unknown


class Floor(NamedTuple):
    """Heights of the ground of a sweep in the world."""

    first: np.ndarray  # (2,) int64, x and y of the first cell
    height: np.ndarray  # (X, Y) float32 metres, mean of the ground points in 3 x 3 cells; NaN = unknown

    @classmethod
    def of(cls, sweep: Sweep) -> Floor:
        """Collect the ground points of a sweep; without a mask, the ground is unknown everywhere."""
        points = as_numpy(sweep.points)[:, :3]
        is_ground = np.zeros(len(points), bool) if sweep.is_ground is None else as_numpy(sweep.is_ground)
        # NaN and infinity are not near.
        is_near = (np.abs(points[:, :2]) <= _FARTHEST).all(axis=1) & np.isfinite(points[:, 2])
        is_used = is_ground & is_near
        if not is_used.any():
            return UNKNOWN_FLOOR
        x, y, z = world_points(sweep, is_used).T
        cell = np.floor(np.stack([x, y], 1) / _CELL).astype(np.int64)
        first = cell.min(axis=0) - 1  # an empty border
        columns, rows = cell.max(axis=0) - first + 2
        index = (cell[:, 0] - first[0]) * rows + cell[:, 1] - first[1]
        count = _around(np.bincount(index, minlength=columns * rows).reshape(columns, rows))
        total = _around(np.bincount(index, z, minlength=columns * rows).reshape(columns, rows))
        height = np.where(count >= _FEWEST_POINTS, total / np.maximum(count, 1), np.nan)
        return cls(first + 1, height.astype(np.float32))

    def below(self, position: np.ndarray) -> np.ndarray:
        """Return the height of the ground at (R, 3) positions in the world, (R,) float64 metres; NaN = unknown."""
        cell = np.floor(position[:, :2] / _CELL).astype(np.int64) - self.first
        inside = ((cell >= 0) & (cell < self.height.shape)).all(axis=1)
        column, row = np.where(inside[:, None], cell, 0).T
        return np.where(inside, self.height[column, row], np.nan).astype(np.float64)


UNKNOWN_FLOOR = Floor(np.zeros(2, np.int64), np.full((1, 1), np.nan, np.float32))


def _around(values: np.ndarray) -> np.ndarray:
    """Sum (X, Y) values over 3 x 3 cells; (X - 2, Y - 2), without the border."""
    return sliding_window_view(values, (3, 3)).sum(axis=(2, 3))  # type: ignore[no-any-return]
