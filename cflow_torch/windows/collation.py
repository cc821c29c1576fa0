"""Collation: windows of arrays or tensors -> one checked batch of tensors in the frame of t+1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Sequence

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.types import Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ground_heights import GroundHeights
from cflow_torch.windows.pieces import groups_of, read_pieces
from cflow_torch.windows.timeline import Timeline


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
        is_active: (P,) bool, False = a row of pc0 that does not take part; its position means nothing.
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
        rows: of each window, where the rows of its pc0 are among the P points; they follow each other.
        pose_flow: (N, 3) float32, metres, T_ego1_ego0 p - p of all rows of pc0; 0 for points that are not finite.
        ground: of the ground points of t and t+1; None = nothing asks.
        point_times: (P,) float32, sweep intervals from the instant of its sweep to the measurement of each point, whole
            2^-20; 0 in windows of which a sweep has none. None = no window has them, or nothing asks.
    """

    positions: Tensor
    is_active: Tensor
    has_result: Tensor
    image: Tensor
    num_newest: int
    num_windows: int
    num_steps: int
    elapsed: Tensor
    seconds: Tensor
    origin: Tensor
    rows: tuple[slice, ...]
    pose_flow: Tensor
    ground: GroundHeights | None = None
    point_times: Tensor | None = None

    def with_twice_the_windows(self) -> Batch:
        """The batch with empty windows B ... 2 B - 1 behind its own, of the same times and origins."""
        elapsed, seconds, origin = (torch.cat((of, of)) for of in (self.elapsed, self.seconds, self.origin))
        return replace(self, num_windows=2 * self.num_windows, elapsed=elapsed, seconds=seconds, origin=origin)

    def both_sides(self) -> tuple[Batch, Tensor]:
        """The sweeps up to t+1, and in as many further windows t+1, t and the sweeps after them.

        Returns:
            The batch: its points, those of later sweeps in window B + w instead of w, then copies of all points of t+1
            and t; and the points that have copies, (K,) int64.
        """
        is_after = (self.elapsed < 0).any(0)
        num_after = int(is_after.sum())
        num_past, first = self.num_steps - num_after, self.num_steps - num_after
        num_steps = max(num_past, num_after + 2)
        window, step = split_index(self.image.long(), self.num_steps)
        copied = flat_nonzero(step < 2)
        is_later = step >= first
        window = torch.where(is_later, window + self.num_windows, window)
        step = torch.where(is_later, step - first + 2, step)
        image = window * num_steps + step
        copies = image.index_select(0, copied) + self.num_windows * num_steps

        def sides(values: Tensor) -> Tensor:
            past, after = (values.new_zeros((self.num_windows, num_steps, *values.shape[2:])) for _ in range(2))
            past[:, :num_past] = values[:, :first]
            after[:, : num_after + 2] = torch.cat((values[:, :2], values[:, first:]), 1)
            return torch.cat((past, after))

        def more(values: Tensor) -> Tensor:
            return torch.cat((values, values.index_select(0, copied)))

        batch = replace(
            self,
            positions=torch.cat((self.positions, self.positions.index_select(1, copied)), 1),
            is_active=more(self.is_active),
            has_result=more(self.has_result),
            image=torch.cat((image, copies)).int(),
            num_windows=2 * self.num_windows,
            num_steps=num_steps,
            elapsed=sides(self.elapsed),
            seconds=sides(self.seconds),
            origin=sides(self.origin),
            ground=None if self.ground is None else self.ground.twice(),
            point_times=None if self.point_times is None else more(self.point_times),
        )
        return batch, copied


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

    Cost: linear in points; the only Python loops over sweeps, because they arrive as lists; on a GPU each
        is read by itself, and what follows is done for all at once.
    """
    timeline = Timeline.of(windows, config, grid, needs_times)
    ground = GroundHeights(len(windows), grid, device) if needs_ground else None
    most, num_steps = sum(entry.sweep.points.shape[0] for entry in timeline.entries), timeline.table.shape[2]
    positions = torch.empty((num_axes, most), dtype=torch.float64, device=device)
    is_active = torch.ones(most, dtype=torch.bool, device=device)
    region = Grid(grid.pixel_size, config.point_cloud_range[:3], config.point_cloud_range[3:])
    has_result = is_active if region == grid else torch.ones_like(is_active)
    image = torch.empty(most, dtype=torch.int32, device=device)
    has_times = any(entry.interval is not None for entry in timeline.entries)
    point_times = torch.zeros(most, dtype=torch.float32, device=device) if has_times else None
    num_rows = [window.pc0.points.shape[0] for window in windows]
    with torch.inference_mode(False):  # becomes part of the results
        pose_flow = torch.zeros((sum(num_rows), 3), dtype=torch.float32, device=device)
    stop = num_newest = 0
    for group in groups_of(timeline.entries, device):
        first_step = group[0].step
        for piece in read_pieces(group, 3 if first_step == 1 else num_axes, grid, config, device):
            if ground is not None and piece.is_ground is not None and first_step <= 1:
                found = flat_nonzero(piece.is_ground)
                ground.add(_take(piece.window, found), piece.moved.index_select(1, found))
            if first_step == 1:  # all rows
                points = slice(stop, stop + piece.is_active.numel())
                positions[:, points] = piece.moved[:num_axes]
                is_active[points] = piece.is_active
                if has_result is not is_active:
                    torch.logical_and(piece.is_active, region.contains(piece.moved), out=has_result[points])
                row = None
            else:
                row = flat_nonzero(piece.is_active)
                points = slice(stop, stop + row.numel())
                for values, of_axis in zip(positions[:, points].unbind(0), piece.moved.unbind(0)):
                    torch.index_select(of_axis, 0, row, out=values)
            image[points] = _take(piece.window * num_steps + piece.step, row)
            if point_times is not None and piece.times is not None:
                point_times[points] = _take(piece.times, row)
            if first_step == 1 and piece.moved is not piece.raw:
                _write_pose_flow(pose_flow[stop - num_newest : points.stop - num_newest], piece.raw, piece.moved)
            stop = points.stop
        num_newest = stop if first_step == 0 else num_newest
    elapsed, seconds, *origin = torch.as_tensor(timeline.table, device=device).unbind(0)
    starts = [num_newest, *(num_newest + last for last in accumulate(num_rows))]
    return Batch(
        positions=positions[:, :stop],
        is_active=is_active[:stop],
        has_result=has_result[:stop],
        image=image[:stop],
        num_newest=num_newest,
        num_windows=len(windows),
        num_steps=num_steps,
        elapsed=elapsed,
        seconds=seconds,
        origin=torch.stack(origin, 2),
        rows=tuple(slice(*ends) for ends in zip(starts, starts[1:])),
        pose_flow=pose_flow,
        ground=ground,
        point_times=None if point_times is None else point_times[:stop],
    )


def _take(values: int | Tensor, row: Tensor | None) -> int | Tensor:
    """Values of some points, None = of all; a number stands for the same value everywhere."""
    return values if row is None or not isinstance(values, Tensor) else values.index_select(0, row)


def _write_pose_flow(pose_flow: Tensor, raw: Tensor, moved: Tensor) -> None:
    """(N, 3) float32 T p - p; 0 for points that are not finite. Overwrites `raw`."""
    for of_axis, difference in zip(pose_flow.unbind(1), torch.sub(moved, raw, out=raw).unbind(0)):
        of_axis.copy_(difference)
    # A point that is not finite has no finite coordinate after the transform.
    pose_flow.nan_to_num_(0.0, 0.0, 0.0)
