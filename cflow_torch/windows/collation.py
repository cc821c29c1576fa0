"""Collate windows of arrays or tensors into one checked batch of tensors in the frame of t+1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Sequence

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.types import Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ground_heights import GroundHeights
from cflow_torch.windows.pieces import read_pieces
from cflow_torch.windows.timeline import Timeline


@dataclass(frozen=True)
class Batch:
    """Points of all sweeps of B windows, sweep by sweep: t+1 of every window, then t of every window, then t-1, ...

    If `num_future` is 0, these are the N given windows. Otherwise B is 2 N: window w has the sweeps up to t+1 of the
    given window w, and window N + w has its t+1, t, t+2, t+3, ...

    The batch holds the active points: finite, not ground, not of the vehicle itself, inside the images. Of pc0 it holds
    every row, so that results are read off in the order of the input. The images may be larger than the region: points
    in the margin are active, but have no result.
    """

    # (A, P) float64, metres, frame of t+1 of the point's window. A = 2 (x and y) if the method needs no z, else 3.
    positions: Tensor
    is_active: Tensor  # (P,) bool, False = a row of pc0 that is not active; its position is undefined
    has_result: Tensor  # (P,) bool, False = a row of pc0 that is not active or lies outside the region
    image: Tensor  # (P,) int32, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1 or t+2, ...
    num_newest: int  # number of points of t+1, the first ones; they are never warped
    num_windows: int  # B
    num_steps: int  # S, number of sweeps of the longest window
    # (B, S) float64, sweep intervals from the sweep to t+1, the k that divides an estimate and scales a warp. 0 for
    # step 0 and for sweeps that a window lacks, negative for sweeps after t+1.
    elapsed: Tensor
    seconds: Tensor  # (B, S) float64, `elapsed` in seconds, for `max_speed`
    origin: Tensor  # (B, S, 3) float64, metres, frame of t+1: origin of the ego frame of each sweep
    rows: tuple[slice, ...]  # for each given window the slice of the P points that holds its pc0
    # (K, 3) float32, metres, T_ego1_ego0 p - p of all rows of these pc0; 0 for points that are not finite
    pose_flow: Tensor
    ground: GroundHeights | None = None  # heights of the ground points of t; None = the method does not need them
    # (P,) float32, sweep intervals from the instant of its sweep to the measurement of each point, multiples of 2^-20;
    # 0 in windows of which a sweep has no times. None = no window has them, or the method does not need them.
    point_times: Tensor | None = None

    def with_empty_windows(self) -> Batch:
        """Append as many windows without points, with the times and origins of the given ones."""
        elapsed, seconds, origin = (torch.cat((of, of)) for of in (self.elapsed, self.seconds, self.origin))
        return replace(self, num_windows=2 * self.num_windows, elapsed=elapsed, seconds=seconds, origin=origin)


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
    num_windows, num_steps = timeline.table.shape[1:]
    ground = GroundHeights(num_windows, grid, device) if needs_ground else None
    pieces = list(read_pieces(timeline, config, grid, device, num_axes, ground))
    point_times = [piece.point_times for piece in pieces if piece.point_times is not None]
    num_newest = sum(piece.image.numel() for piece in pieces if piece.step == 0)
    starts = list(accumulate([num_newest, *(window.pc0.points.shape[0] for window in windows)]))
    with torch.inference_mode(False):  # becomes part of the results
        all_pose_flow = torch.cat([piece.pose_flow for piece in pieces if piece.pose_flow is not None])
        pose_flow = all_pose_flow[: starts[-1] - num_newest]
    elapsed, seconds, *origin = torch.as_tensor(timeline.table, device=device).unbind(0)
    return Batch(
        positions=torch.cat([piece.positions for piece in pieces], 1),
        is_active=torch.cat([piece.is_active for piece in pieces]),
        has_result=torch.cat([piece.has_result for piece in pieces]),
        image=torch.cat([piece.image for piece in pieces]),
        num_newest=num_newest,
        num_windows=num_windows,
        num_steps=num_steps,
        elapsed=elapsed,
        seconds=seconds,
        origin=torch.stack(origin, 2),
        rows=tuple(slice(*ends) for ends in zip(starts, starts[1:])),
        pose_flow=pose_flow,
        ground=ground,
        point_times=torch.cat(point_times) if point_times else None,
    )
