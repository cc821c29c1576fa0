"""Collate windows of arrays or tensors into one checked batch of tensors in the frame of t+1."""

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
from cflow_torch.windows.pieces import PieceReader
from cflow_torch.windows.timeline import Timeline


@dataclass(frozen=True)
class Batch:
    """Points of all sweeps of all windows, sweep by sweep: t+1 of every window, then t of every window, then t-1, ...,
    then t+2, t+3, ...

    The batch holds the active points: finite, not ground, not of the vehicle itself, inside the images. Of pc0 it holds
    every row, so that results are read off in the order of the input. The images may be larger than the region: points
    in the margin are active, but have no result.
    """

    # (A, P) float64, metres, frame of t+1 of the point's window. A = 2 (x and y) if the method needs no z, else 3.
    positions: Tensor
    is_active: Tensor  # (P,) bool, False = a row of pc0 that is not active; its position is undefined
    has_result: Tensor  # (P,) bool, False = a row of pc0 that is not active or lies outside the region
    # (P,) int32, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1, .... Steps of sweeps
    # after t+1 follow those of the longest history.
    image: Tensor
    num_newest: int  # number of points of t+1, the first ones; they are never warped
    num_windows: int  # B
    num_steps: int  # S, 1 + the longest list of sweeps up to t + the longest list of sweeps after t+1
    # (B, S) float64, sweep intervals from the sweep to t+1, the k that divides an estimate and scales a warp. 0 for
    # step 0 and for sweeps that a window lacks, negative for sweeps after t+1.
    elapsed: Tensor
    seconds: Tensor  # (B, S) float64, `elapsed` in seconds, for `max_speed`
    origin: Tensor  # (B, S, 3) float64, metres, frame of t+1: origin of the ego frame of each sweep
    rows: tuple[slice, ...]  # for each window the slice of the P points that holds its pc0
    pose_flow: Tensor  # (N, 3) float32, metres, T_ego1_ego0 p - p of all rows of pc0; 0 for points that are not finite
    ground: GroundHeights | None = None  # heights of the ground points of t; None = the method does not need them
    # (P,) float32, sweep intervals from the instant of its sweep to the measurement of each point, multiples of 2^-20;
    # 0 in windows of which a sweep has no times. None = no window has them, or the method does not need them.
    point_times: Tensor | None = None

    def with_empty_windows(self) -> Batch:
        """Append as many windows without points, with the times and origins of the given ones."""
        elapsed, seconds, origin = (torch.cat((of, of)) for of in (self.elapsed, self.seconds, self.origin))
        return replace(self, num_windows=2 * self.num_windows, elapsed=elapsed, seconds=seconds, origin=origin)

    def split_past_and_future(self) -> tuple[Batch, Tensor]:
        """Return a batch in which sweeps after t+1 have windows of their own, and the copied points, (K,) int64.

        Of its 2 B windows, window w has the sweeps up to t+1, and window B + w has t+1, t and the sweeps after t+1. Its
        points are those of this batch, then copies of all points of t+1 and t for the windows B ... 2 B - 1.
        """
        num_future = int((self.elapsed < 0).any(0).sum())
        num_past = self.num_steps - num_future
        num_steps = max(num_past, num_future + 2)
        window, step = split_index(self.image.long(), self.num_steps)
        copied, is_future = flat_nonzero(step < 2), step >= num_past
        window = torch.where(is_future, window + self.num_windows, window)
        image = window * num_steps + torch.where(is_future, step - num_past + 2, step)
        copies = image.index_select(0, copied) + self.num_windows * num_steps

        def of_windows(values: Tensor) -> Tensor:
            past, future = (values.new_zeros((self.num_windows, num_steps, *values.shape[2:])) for _ in range(2))
            past[:, :num_past] = values[:, :num_past]
            future[:, : num_future + 2] = torch.cat((values[:, :2], values[:, num_past:]), 1)
            return torch.cat((past, future))

        def with_copies(values: Tensor) -> Tensor:
            return torch.cat((values, values.index_select(0, copied)))

        batch = replace(
            self,
            positions=torch.cat((self.positions, self.positions.index_select(1, copied)), 1),
            is_active=with_copies(self.is_active),
            has_result=with_copies(self.has_result),
            image=torch.cat((image, copies)).int(),
            num_windows=2 * self.num_windows,
            num_steps=num_steps,
            elapsed=of_windows(self.elapsed),
            seconds=of_windows(self.seconds),
            origin=of_windows(self.origin),
            ground=None if self.ground is None else self.ground.repeated(),
            point_times=None if self.point_times is None else with_copies(self.point_times),
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
    """Check windows, bring every sweep into the frame of its t+1, and keep the active points.

    Args:
        windows: B windows, at least one.
        config: of a method. If a history is longer, its nearest sweeps are used.
        grid: the images of any scale; they contain the region.
        device: device of the batch.
        num_axes: coordinates to keep, 2 or 3.
        needs_ground, needs_times: also keep the heights of the ground, or the times of the points.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, tensors on several devices, poses for some
            sweeps only, more sweeps after t+1 than `num_future`, time stamps out of order, poses too far apart.

    Cost: linear in points. The only Python loops are over sweeps, because these arrive as lists.
    """
    timeline = Timeline.of(windows, config, grid, needs_times)
    ground = GroundHeights(len(windows), grid, device) if needs_ground else None
    pieces = list(PieceReader(timeline, config, grid, device, num_axes, ground).pieces())
    with torch.inference_mode(False):  # becomes part of the results
        pose_flow = torch.cat([piece.pose_flow for piece in pieces if piece.pose_flow is not None])
    point_times = [piece.point_times for piece in pieces if piece.point_times is not None]
    num_newest = sum(piece.image.numel() for piece in pieces if piece.step == 0)
    starts = list(accumulate([num_newest, *(window.pc0.points.shape[0] for window in windows)]))
    elapsed, seconds, *origin = torch.as_tensor(timeline.table, device=device).unbind(0)
    return Batch(
        positions=torch.cat([piece.positions for piece in pieces], 1),
        is_active=torch.cat([piece.is_active for piece in pieces]),
        has_result=torch.cat([piece.has_result for piece in pieces]),
        image=torch.cat([piece.image for piece in pieces]),
        num_newest=num_newest,
        num_windows=len(windows),
        num_steps=timeline.table.shape[2],
        elapsed=elapsed,
        seconds=seconds,
        origin=torch.stack(origin, 2),
        rows=tuple(slice(*ends) for ends in zip(starts, starts[1:])),
        pose_flow=pose_flow,
        ground=ground,
        point_times=torch.cat(point_times) if point_times else None,
    )
