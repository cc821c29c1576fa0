"""Points of sweeps, read and brought into the frame of t+1 piece by piece."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby
from typing import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.chunks import chunks
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import compensate
from cflow_torch.windows.point_times import read_point_times
from cflow_torch.windows.timeline import Entry
from cflow_torch.windows.validation import join_positions, read_ground, read_positions


@dataclass(frozen=True)
class Piece:
    """N points of one sweep, or of all sweeps of a kind: t+1, t, or others.

    Args:
        window, step: of each point, (N,) int64, or one number for all.
        raw: (3, N) float64, metres, as given.
        moved: (A or 3, N) float64, metres, frame of t+1; `raw` itself where no sweep has a transform.
        is_active: (N,) bool.
        is_ground: (N,) bool, ground inside the images; None = not known.
        times: (N,) float64, sweep intervals; None = they do not count.
    """

    window: int | Tensor
    step: int | Tensor
    raw: Tensor
    moved: Tensor
    is_active: Tensor
    is_ground: Tensor | None
    times: Tensor | None


def groups_of(entries: Sequence[Entry], device: torch.device) -> list[list[Entry]]:
    """Sweeps that are read at once: on a CPU each alone, elsewhere all of t+1, all of t, all others, since a GPU waits
    for operations rather than for memory."""
    if device.type == "cpu":
        return [[entry] for entry in entries]
    return [list(group) for _, group in groupby(entries, lambda entry: min(entry.step, 2))]


def read_pieces(
    group: Sequence[Entry], num_axes: int, grid: Grid, config: Config, device: torch.device
) -> Iterator[Piece]:
    """The points of some sweeps: of one sweep in pieces that fit a CPU's cache, of several at once.

    Args:
        group: as `groups_of` gives it.
        num_axes: A, coordinates that are asked for.
        grid, config, device: as for `make_batch`.
    """
    sizes = [entry.sweep.points.shape[0] for entry in group]
    ground, times = _ground(group, sizes, device), _times(group, sizes, device)
    matrices = [entry.T_ego1_ego for entry in group]
    matrix: Tensor | None = None
    window: int | Tensor = group[0].window
    step: int | Tensor = group[0].step
    if any(T is not None for T in matrices):
        given = np.stack([np.eye(4) if T is None else T for T in matrices], 2)[:3]  # the last row is known
        matrix = torch.as_tensor(given, device=device)
    if len(group) > 1:
        count = torch.as_tensor(sizes, device=device)
        of_point = torch.arange(len(sizes), device=device).repeat_interleave(count, output_size=sum(sizes))
        known = torch.as_tensor([(entry.window, entry.step) for entry in group], device=device)
        window, step = known.index_select(0, of_point).unbind(1)
        matrix = None if matrix is None else matrix.index_select(2, of_point)
    # z matters where the region bounds it. After a transform, a z that is not finite has spoiled x and y as well.
    is_flat = matrix is not None and math.isinf(grid.lower[2]) and math.isinf(grid.upper[2])
    checked_axes = 2 if is_flat else 3
    for rows in chunks(0, sizes[0], device) if len(group) == 1 else [slice(None)]:
        sweeps = [entry.sweep for entry in group]
        raw = read_positions(sweeps[0], device, rows) if len(sweeps) == 1 else join_positions(sweeps, device)
        moved = raw if matrix is None else compensate(raw, matrix, max(num_axes, checked_axes))
        is_active, is_ground = grid.contains(moved[:checked_axes]), None
        if ground is not None:
            is_ground = is_active & ground[rows]
            is_active &= ~ground[rows]
        if config.ego_box is not None:
            x0, y0, x1, y1 = config.ego_box
            is_active &= (raw[0] < x0) | (raw[0] > x1) | (raw[1] < y0) | (raw[1] > y1)
        yield Piece(window, step, raw, moved, is_active, is_ground, None if times is None else times[rows])


def _ground(group: Sequence[Entry], sizes: Sequence[int], device: torch.device) -> Tensor | None:
    """(N,) bool of all points, False in sweeps without a mask; None = no sweep has one."""
    if all(entry.sweep.is_ground is None for entry in group):
        return None
    masks = [
        torch.zeros(size, dtype=torch.bool, device=device)
        if entry.sweep.is_ground is None
        else read_ground(entry.sweep, entry.name, size, device)
        for entry, size in zip(group, sizes)
    ]
    return masks[0] if len(masks) == 1 else torch.cat(masks)


def _times(group: Sequence[Entry], sizes: Sequence[int], device: torch.device) -> Tensor | None:
    """(N,) float64 sweep intervals of all points, 0 in sweeps whose times do not count; None = those of none do."""
    if all(entry.interval is None for entry in group):
        return None
    times = [
        torch.zeros(size, dtype=torch.float64, device=device)
        if entry.interval is None
        else read_point_times(entry.sweep, entry.name, entry.interval, device)
        for entry, size in zip(group, sizes)
    ]
    return times[0] if len(times) == 1 else torch.cat(times)
