"""Collation: windows of arrays or tensors -> one checked batch of tensors in the frame of t+1."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Iterator, List, Optional, Sequence, Tuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.types import Sweep, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import compensate, rigid_transform
from cflow_torch.windows.ground_heights import GroundHeights
from cflow_torch.windows.point_times import has_point_times, read_point_times
from cflow_torch.windows.validation import (
    check_distance,
    elapsed_times,
    keep_nearest,
    read_ground,
    read_positions,
    source_sweeps,
)


@dataclass(frozen=True)
class Batch:
    """Points of all sweeps of all windows, sweep by sweep: t+1 of every window, then t of every window, then t-1, ...,
    then t+2, t+3, ...

    Points that do not take part (not finite, ground, the vehicle's own, outside the images) are left out, but for those
    of pc0: all its rows are here, so that results are read off without being scattered. The images may be larger than
    the region: what lies in their margin takes part, but has no result.

    Args:
        positions: (A, P) float64, metres, frame of t+1 of the point's window; A = 2, x and y, where nothing asks for z,
            else 3.
        takes_part: (P,) bool, False = a row of pc0 that does not take part; its position means nothing.
        has_result: (P,) bool, False = a row of pc0 that does not take part, or lies outside the region.
        image: (P,) int32, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1, ...,
            steps of sweeps after t+1 stand behind those of the longest history.
        num_newest: number of points of t+1, the first ones; they are never warped.
        num_windows: B.
        num_steps: S, 1 + the longest list of sweeps up to t + the longest list of sweeps after t+1.
        elapsed: (B, S) float64, sweep intervals from the sweep to t+1: the k that divides an estimate and
            scales a warp (0 for step 0 and for sweeps that a window lacks, negative for sweeps after t+1).
        seconds: (B, S) float64, the same in seconds, for `max_speed`.
        origin: (B, S, 3) float64, metres, frame of t+1: where the ego frame of each sweep has its origin.
        sources: of each window, what its result is made of.
        ground: of the ground points of t and t+1; None = nothing asks.
        point_times: (P,) float32, sweep intervals from the instant of its sweep to the measurement of each point, whole
            2^-20; 0 in windows of which a sweep has none. None = no window has them, or nothing asks.
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
    origin: Tensor
    sources: Tuple[Source, ...]
    ground: Optional[GroundHeights] = None
    point_times: Optional[Tensor] = None

    def take_steps(self, wanted: Tensor) -> Batch:
        """The batch of some of the sweeps. Args: wanted: (S,) bool, True for steps 0 and 1."""
        kept, number = flat_nonzero(wanted), wanted.cumsum(0) - 1
        window, step = split_index(self.image.long(), self.num_steps)
        rows = flat_nonzero(wanted.index_select(0, step))  # rows of pc0 stay where they are: newer ones stay as well
        image = window * kept.numel() + number.index_select(0, step)
        return replace(
            self,
            positions=self.positions.index_select(1, rows),
            takes_part=self.takes_part.index_select(0, rows),
            has_result=self.has_result.index_select(0, rows),
            image=image.index_select(0, rows).int(),
            num_steps=kept.numel(),
            elapsed=self.elapsed.index_select(1, kept),
            seconds=self.seconds.index_select(1, kept),
            origin=self.origin.index_select(1, kept),
            point_times=None if self.point_times is None else self.point_times.index_select(0, rows),
        )


@dataclass(frozen=True)
class Source:
    """pc0 of one window: its N rows.

    Args:
        points: where they are among the P points of the batch.
        pose_flow: (N, 3) float32.
    """

    points: slice
    pose_flow: Tensor


def make_batch(
    windows: Sequence[Window],
    config: Config,
    grid: Grid,
    device: torch.device,
    num_axes: int = 2,
    needs_ground: bool = False,
    needs_times: bool = False,
) -> Batch:
    """Check windows, bring every sweep into the frame of its t+1, keep what takes part.

    Args:
        windows: B windows, at least one.
        config: `ego_box`, `sweep_interval`, `point_cloud_range`; the nearest `num_history` older
            sweeps are used; `num_future` bounds what is accepted.
        grid: the images, which hold the region; which of the scales they belong to does not matter here.
        device: where the batch is to lie.
        num_axes: coordinates that are kept, 2 or 3.
        needs_ground: whether heights of the ground are kept as well.
        needs_times: whether the times of points are kept as well.

    Returns:
        The batch, on one device.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, mixed devices, poses for some sweeps
            only, more sweeps after t+1 than `num_future`, time stamps out of order, poses too far apart.

    Cost: linear in points; the only Python loop over sweeps, because they arrive as a list.
    """
    windows = [keep_nearest(window, config.num_history) for window in windows]
    kept = [source_sweeps(window, config) for window in windows]
    num_future = [sum(way < 0 for _, _, way in sources) for sources in kept]
    first_future = 1 + max(len(sources) - count for sources, count in zip(kept, num_future))
    num_steps = first_future + max(num_future)
    elapsed, seconds = np.zeros((2, len(windows), num_steps))
    origin = np.zeros((len(windows), num_steps, 3))
    sweeps: List[Tuple[int, int, str, Sweep]] = []
    for index, (window, sources, count) in enumerate(zip(windows, kept, num_future)):
        steps = [*range(1, 1 + len(sources) - count), *range(first_future, first_future + count)]
        elapsed[index, steps], seconds[index, steps] = zip(*elapsed_times(window, sources, config))
        sweeps.append((0, index, "pc1", window.pc1))
        sweeps += [(step, index, name, sweep) for step, (name, sweep, _) in zip(steps, sources)]
    sweeps.sort(key=lambda entry: entry[0])  # stable: all t+1, then all t, then what is older, then what is newer
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
    has_times = [needs_times and has_point_times(window, sources) for window, sources in zip(windows, kept)]
    point_times = torch.zeros(most, dtype=torch.float32, device=device) if any(has_times) else None
    stop, num_newest, of_pc0 = 0, 0, []
    for step, index, name, sweep in sweeps:
        start, transform = stop, None
        if step > 0 and to_ego1[index] is not None:
            transform = to_ego1[index] @ rigid_transform(sweep.pose, f"pose of {name}", farthest)
            check_distance(transform, name)
            origin[index, step] = transform[:3, 3]
        if step == 1:
            with torch.inference_mode(False):  # becomes part of the result
                pose_flow = torch.zeros((sweep.points.shape[0], 3), dtype=torch.float32, device=device)
            of_pc0.append(Source(slice(start, start + len(pose_flow)), pose_flow))
        interval = seconds[index, 1] / elapsed[index, 1]
        times = read_point_times(sweep, name, interval, device) if has_times[index] else None
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
            if times is not None and point_times is not None:
                point_times[points] = times[rows] if step == 1 else times[rows].index_select(0, row)
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
        origin=torch.as_tensor(origin, device=device),
        sources=tuple(of_pc0),
        ground=ground,
        point_times=None if point_times is None else point_times[:stop],
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
