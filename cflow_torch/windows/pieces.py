"""Read the points of sweeps and bring them into the frame of t+1, piece by piece."""

from __future__ import annotations

import math
from itertools import groupby
from typing import Any, Iterator, NamedTuple, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, take_columns
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import compensate
from cflow_torch.windows.ground_heights import GroundHeights
from cflow_torch.windows.timeline import Entry, Timeline
from cflow_torch.windows.validation import read_ground, read_point_times, read_positions


class Piece(NamedTuple):
    """K points of one sweep, or of all sweeps of a kind: all points of sweeps t, the active points of other sweeps."""

    step: int  # smallest step of the sweeps
    positions: Tensor  # this field and the next four are as in `Batch`
    is_active: Tensor
    has_result: Tensor
    image: Tensor
    point_times: Tensor | None
    # (K, 3) float32, metres, T_ego1_ego0 p - p of sweep t, 0 for points that are not finite; None for other sweeps.
    pose_flow: Tensor | None


def read_pieces(
    timeline: Timeline,
    config: Config,
    grid: Grid,
    device: torch.device,
    num_axes: int,
    ground: GroundHeights | None,
) -> Iterator[Piece]:
    """Yield the pieces in the order of the timeline, and add the ground points of t to `ground`, if it is not None.

    The other arguments are as for `make_batch`. For a CPU we read each sweep alone, in pieces that fit its cache. On a
    GPU few launches matter more, so we read all sweeps t+1 at once, then all sweeps t, then all others.
    """
    on_cpu, num_steps = device.type == "cpu", timeline.table.shape[2]
    region = Grid(grid.pixel_size, config.point_cloud_range[:3], config.point_cloud_range[3:])
    has_times = any(entry.interval is not None for entry in timeline.entries)
    for _, entries in groupby(timeline.entries, lambda entry: entry[:2] if on_cpu else min(entry.step, 2)):
        group = list(entries)
        step, sweeps = group[0].step, [entry.sweep for entry in group]
        window, image, matrix = _of_points(group, num_steps, device)
        is_ground = None if all(sweep.is_ground is None for sweep in sweeps) else read_ground(sweeps, device)
        times = None
        if has_times:
            times = torch.cat([read_point_times(entry.sweep, entry.name, entry.interval, device) for entry in group])
        # We need not check an unbounded z after a transform, which spreads a z that is not finite to x and y.
        skips_z = matrix is not None and math.isinf(grid.lower[2]) and math.isinf(grid.upper[2])
        checked_axes = 2 if skips_z else 3
        moved_axes = 3 if step == 1 else max(num_axes, checked_axes)
        # An empty sweep gives an empty piece.
        for rows in chunks(0, max(sweeps[0].points.shape[0], 1), device) if on_cpu else [slice(None)]:
            raw = read_positions(sweeps, device, rows)
            moved = raw if matrix is None else compensate(raw, matrix, moved_axes)
            is_active, pose_flow, row = grid.contains(moved[:checked_axes]), None, None
            if is_ground is not None:
                if ground is not None and step == 1:
                    found = flat_nonzero(is_active & is_ground[rows])
                    ground.add(_select(window, found), take_columns(moved, found))
                is_active &= ~is_ground[rows]
            if config.ego_box is not None:
                x0, y0, x1, y1 = config.ego_box
                is_active &= (raw[0] < x0) | (raw[0] > x1) | (raw[1] < y0) | (raw[1] > y1)
            if step == 1:
                has_result = is_active if region == grid else is_active & region.contains(moved)
                pose_flow = _pose_flow(raw, moved)
                positions = moved[:num_axes]
            else:
                row = flat_nonzero(is_active)
                is_active = has_result = torch.ones_like(row, dtype=torch.bool)
                positions = take_columns(moved[:num_axes], row)
            if isinstance(image, Tensor):
                of_point = _select(image, row)
            else:
                of_point = torch.full_like(is_active, image, dtype=torch.int32)
            point_times = None if times is None else _select(times[rows], row).float()
            yield Piece(step, positions, is_active, has_result, of_point, point_times, pose_flow)


def _of_points(
    group: Sequence[Entry], num_steps: int, device: torch.device
) -> tuple[int | Tensor, int | Tensor, Tensor | None]:
    """Return window and image of each point, (N,) or one number, and transforms, (3, 4, N), (3, 4, 1) or None."""
    matrix = None
    if any(entry.T_ego1_ego is not None for entry in group):
        given = [np.eye(4) if entry.T_ego1_ego is None else entry.T_ego1_ego for entry in group]
        matrix = torch.as_tensor(np.stack(given, 2)[:3], device=device)  # the last row is known
    if len(group) == 1:
        return group[0].window, group[0].window * num_steps + group[0].step, matrix
    known = [(e.window, e.window * num_steps + e.step, e.sweep.points.shape[0]) for e in group]
    window, image, count = torch.as_tensor(known, device=device).unbind(1)
    entry = torch.repeat_interleave(count, output_size=sum(size for *_, size in known))
    window, image = window.index_select(0, entry), image.int().index_select(0, entry)
    return window, image, None if matrix is None else matrix.index_select(2, entry)


def _select(values: Any, row: Tensor | None) -> Any:
    """Select the values of the points `row`, None = all. A number is the value of every point, and stays."""
    return values if row is None or not isinstance(values, Tensor) else values.index_select(0, row)


def _pose_flow(raw: Tensor, moved: Tensor) -> Tensor:
    """Return T p - p, (N, 3) float32; 0 for points that are not finite. Overwrite `raw`."""
    flow = torch.zeros((raw.shape[1], 3), dtype=torch.float32, device=raw.device)
    if moved is raw:
        return flow
    # Column by column, because on the CPU a transposed copy of all three takes longer.
    for of_axis, difference in zip(flow.unbind(1), torch.sub(moved, raw, out=raw).unbind(0)):
        of_axis.copy_(difference)
    # A point that is not finite has no finite coordinate after the transform.
    return flow.nan_to_num_(0.0, 0.0, 0.0)
