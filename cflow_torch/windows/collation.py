"""Collation: windows of arrays or tensors -> one checked batch of tensors in the frame of t+1."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Iterator, List, Optional, Sequence, Tuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.types import Sweep, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import compensate, rigid_transform
from cflow_torch.windows.ground_heights import GroundHeights
from cflow_torch.windows.memory import require_memory
from cflow_torch.windows.validation import (
    check_distance,
    elapsed_times,
    read_ground,
    read_positions,
    source_sweeps,
)

# Working memory of a pixel of every sweep (occupancy and cluster) before the clusters of a window are known.
_BYTES_PER_PIXEL = 10
# What windows of a group may take on a CPU where `max_memory` says nothing: about 9 of a pair, 4 of six sweeps. Fresh
# pages of larger arrays cost more than the operations that larger groups save.
_BYTES_ON_CPU = 1 << 29


@dataclass(frozen=True)
class Batch:
    """Points of all sweeps of all windows, sweep by sweep: t+1 of every window, then t of every window, then t-1, ...

    Points that do not take part (not finite, ground, the vehicle's own, outside the images) are left out, but for those
    of pc0: all its rows are here, so that results are read off without being scattered. The images may be larger than
    the region: what lies in their margin takes part, but has no result.

    Args:
        positions: (A, P) float64, metres, frame of t+1 of the point's window; A = 2, x and y, where nothing asks for z,
            else 3.
        takes_part: (P,) bool, False = a row of pc0 that does not take part; its position means nothing.
        has_result: (P,) bool, takes part and lies in the region; means nothing for other sweeps than pc0.
        image: (P,) int32, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1, ...
        num_newest: number of points of t+1, the first ones; they are never warped.
        num_windows: B.
        num_steps: S, 1 + the longest list of source sweeps.
        elapsed: (B, S) float64, sweep intervals from the sweep to t+1: the k that divides an estimate and
            scales a warp (0 for step 0).
        seconds: (B, S) float64, the same in seconds, for `max_speed`.
        sources: of each window, what its result is made of.
        ground: of the ground points of t and t+1; None = nothing asks.
    """

    positions: Tensor
    takes_part: Tensor
    has_result: Tensor
    image: Tensor
    num_newest: int
    num_windows: int
    num_steps: int
    elapsed: Tensor
    seconds: Tensor
    sources: Tuple[Source, ...]
    ground: Optional[GroundHeights] = None


@dataclass(frozen=True)
class Source:
    """pc0 of one window: its N rows.

    Args:
        points: where they are among the P points of the batch.
        pose_flow: (N, 3) float32.
    """

    points: slice
    pose_flow: Tensor


def split_windows(
    windows: Sequence[Window], grid: Grid, device: torch.device, bytes_per_point: int, max_memory: Optional[float]
) -> List[List[Window]]:
    """Windows in groups that fit the memory, in order. The result of a window does not depend on its group.

    Args:
        windows: B windows, checked; an empty list gives no group.
        grid: the finest scale, whose images are the largest.
        device: where the work is done; on a CPU large groups only cost more.
        bytes_per_point: what a method plans with for each point.
        max_memory: bytes; None = one group, or groups of `_BYTES_ON_CPU`.

    Returns:
        Groups of at least one window.

    Raises:
        CFlowError: a window alone needs more memory than there is.
    """
    groups: List[List[Window]] = []
    if max_memory is None and device.type == "cpu":
        max_memory = _BYTES_ON_CPU
    used = 0
    for window in windows:
        sweeps = (window.pc1, window.pc0, *window.pch)
        points = sum(sweep.points.shape[0] for sweep in sweeps)
        needed = bytes_per_point * points + (_BYTES_PER_PIXEL * len(sweeps) + 30) * grid.height * grid.width
        require_memory(
            needed,
            device,
            f"a window of {points} points in {len(sweeps)} sweeps, on {grid.width} x {grid.height} pixels of "
            f"{grid.pixel_size} m,",
            "give a smaller point_cloud_range, larger pixel_sizes or fewer points",
        )
        if not groups or (max_memory is not None and used + needed > max_memory):
            groups.append([])
            used = 0
        groups[-1].append(window)
        used += needed
    return groups


def make_batch(
    windows: Sequence[Window],
    config: Config,
    grid: Grid,
    device: torch.device,
    num_axes: int = 2,
    needs_ground: bool = False,
) -> Batch:
    """Check windows, bring every sweep into the frame of its t+1, keep what takes part.

    Args:
        windows: B windows, at least one.
        config: `ego_box`, `sweep_interval`, `point_cloud_range`; `num_history` bounds the history that is accepted.
        grid: the images, which hold the region; which of the scales they belong to does not matter here.
        device: where the batch is to lie.
        num_axes: coordinates that are kept, 2 or 3.
        needs_ground: whether heights of the ground are kept as well.

    Returns:
        The batch, on one device.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, mixed devices, poses for some sweeps
            only, more history than `num_history`, time stamps out of order or with gaps, poses too far apart.

    Cost: linear in points; the only Python loop over sweeps, because they arrive as a list.
    """
    kept = [source_sweeps(window, config) for window in windows]
    num_steps = 1 + max(len(sources) for sources in kept)
    elapsed, seconds = np.zeros((2, len(windows), num_steps))
    sweeps: List[Tuple[int, int, str, Sweep]] = []
    for index, (window, older) in enumerate(zip(windows, kept)):
        times = elapsed_times(window, older, config)
        elapsed[index, 1 : 1 + len(times)], seconds[index, 1 : 1 + len(times)] = zip(*times)
        named = [("pc1", window.pc1), *((name, sweep) for name, sweep, _ in older)]
        sweeps += [(step, index, name, sweep) for step, (name, sweep) in enumerate(named)]
    sweeps.sort(key=lambda entry: entry[0])  # stable: all t+1, then all t, then what is older
    farthest = max(map(abs, (*grid.lower[:2], *grid.upper[:2])))
    to_ego1 = [
        None if window.pc1.pose is None else np.linalg.inv(rigid_transform(window.pc1.pose, "pose1", farthest))
        for window in windows
    ]

    ground = GroundHeights(len(windows), grid, device) if needs_ground else None
    most = sum(sweep.points.shape[0] for _, _, _, sweep in sweeps)
    positions = torch.empty((num_axes, most), dtype=torch.float64, device=device)
    takes_part = torch.ones(most, dtype=torch.bool, device=device)
    region = Grid(grid.pixel_size, config.point_cloud_range[:3], config.point_cloud_range[3:])
    has_result = takes_part if region == grid else torch.ones_like(takes_part)
    image = torch.empty(most, dtype=torch.int32, device=device)
    stop, num_newest, sources = 0, 0, []
    for step, index, name, sweep in sweeps:
        start, transform = stop, None
        if step > 0 and to_ego1[index] is not None:
            transform = to_ego1[index] @ rigid_transform(sweep.pose, f"pose of {name}", farthest)
            check_distance(transform, name)
        if step == 1:
            with torch.inference_mode(False):  # becomes part of the result
                pose_flow = torch.zeros((sweep.points.shape[0], 3), dtype=torch.float32, device=device)
            sources.append(Source(slice(start, start + len(pose_flow)), pose_flow))
        for rows, raw, moved, inside, ground_inside in _pieces(
            sweep, name, transform, 3 if step == 1 else num_axes, grid, config, device
        ):
            if ground is not None and ground_inside is not None and step <= 1:
                ground.add(index, moved.index_select(1, flat_nonzero(ground_inside)))
            if step == 1:  # all rows
                points = slice(stop, stop + inside.numel())
                positions[:, points] = moved[:num_axes]
                takes_part[points] = inside
                if has_result is not takes_part:
                    torch.logical_and(inside, region.contains(moved), out=has_result[points])
                if transform is not None:
                    _write_pose_flow(pose_flow[rows], raw, moved)
            else:
                row = flat_nonzero(inside)
                points = slice(stop, stop + row.numel())
                for values, of_axis in zip(positions[:, points].unbind(0), moved.unbind(0)):
                    torch.index_select(of_axis, 0, row, out=values)
            stop = points.stop
        image[start:stop] = index * num_steps + step
        num_newest = stop if step == 0 else num_newest
    return Batch(
        positions=positions[:, :stop],
        takes_part=takes_part[:stop],
        has_result=has_result[:stop],
        image=image[:stop],
        num_newest=num_newest,
        num_windows=len(windows),
        num_steps=num_steps,
        elapsed=torch.as_tensor(elapsed, device=device),
        seconds=torch.as_tensor(seconds, device=device),
        sources=tuple(sources),
        ground=ground,
    )


def _pieces(
    sweep: Sweep,
    name: str,
    transform: Optional[np.ndarray],
    num_axes: int,
    grid: Grid,
    config: Config,
    device: torch.device,
) -> Iterator[Tuple[slice, Tensor, Tensor, Tensor, Optional[Tensor]]]:
    """A sweep piece by piece.

    Yields:
        Rows; (3, N) positions as given; (A or 3, N) in the frame of t+1; (N,) takes part; (N,) is ground
        inside the region, if known.
    """
    num_points = sweep.points.shape[0]
    is_ground = None if sweep.is_ground is None else read_ground(sweep, name, num_points, device)
    # z matters where the region bounds it. After a transform, a z that is not finite has spoiled x and y as well.
    is_flat = transform is not None and math.isinf(grid.lower[2]) and math.isinf(grid.upper[2])
    checked_axes = 2 if is_flat else 3
    matrix = None if transform is None else torch.as_tensor(transform, device=device)
    for rows in chunks(0, num_points, device):
        raw = read_positions(sweep, device, rows)
        moved = compensate(raw, matrix, max(num_axes, checked_axes))
        inside = grid.contains(moved[:checked_axes])
        ground_inside = None
        if is_ground is not None:
            ground_inside = inside & is_ground[rows]
            inside &= ~is_ground[rows]
        if config.ego_box is not None:
            x0, y0, x1, y1 = config.ego_box
            inside &= (raw[0] < x0) | (raw[0] > x1) | (raw[1] < y0) | (raw[1] > y1)
        yield rows, raw, moved, inside, ground_inside


def _write_pose_flow(pose_flow: Tensor, raw: Tensor, moved: Tensor) -> None:
    """(N, 3) float32 T p - p; 0 for points that are not finite. Overwrites `raw`."""
    for of_axis, difference in zip(pose_flow.unbind(1), torch.sub(moved, raw, out=raw).unbind(0)):
        of_axis.copy_(difference)
    # A point that is not finite has no finite coordinate after the transform.
    pose_flow.nan_to_num_(0.0, 0.0, 0.0)
