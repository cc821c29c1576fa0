"""Collate windows of arrays or tensors into one checked batch of tensors in the frame of t+1."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import accumulate
from typing import Iterator, NamedTuple, Sequence

import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.ground.heights import GroundHeights
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero, split_index
from cflow_torch.types import Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.coverage import Coverage
from cflow_torch.windows.pieces import read_pieces
from cflow_torch.windows.timeline import Timeline


class Chunk(NamedTuple):
    """Points of a batch that we process at once."""

    points: slice
    window: int | Tensor  # of all these points, or (n,) int64
    step: int | Tensor


@dataclass(frozen=True)
class Batch:
    """Points of all sweeps of B windows, sweep by sweep: t+1 of every window, then t of every window, then t-1, ...

    If `num_future` is 0, the B windows are the N given ones. Otherwise B is 2 N: window w has the sweeps up to t+1 of
    the given window w, and window N + w has its sweeps t+1, t, t+2, t+3, ...

    Active points are finite, not ground, not of the vehicle itself, and inside the images. The batch holds the active
    points of all sweeps and the other rows of pc0, so that results keep the order of the input. The images may be
    larger than the region. Points in this margin are active, but have no result.
    """

    # (A, P) float64, metres, frame of t+1 of the point's window. A = 2 (x and y) if the method needs no z, else 3.
    positions: Tensor
    is_active: Tensor  # (P,) bool, False = a row of pc0 that is not active; its position is undefined
    has_result: Tensor  # (P,) bool, False = a row of pc0 that is not active or outside the region; True in other sweeps
    image: Tensor  # (P,) int32, window * num_steps + step of each point; step 0 = sweep t+1, 1 = t, 2 = t-1 or t+2, ...
    num_newest: int  # number of points of t+1, which come first and are never warped
    num_windows: int  # B
    num_steps: int  # S, number of sweeps of the longest window
    has_pairs: bool  # some windows have two sweeps only
    # (B, S) float64, time k from each sweep to t+1 in sweep intervals: a displacement is k times the flow. 1 for sweep
    # t, 0 for step 0 and for sweeps that a window lacks, negative for sweeps after t+1.
    elapsed: Tensor
    seconds: Tensor  # (B, S) float64, `elapsed` in seconds, for `max_speed`
    origin: Tensor  # (B, S, 3) float64, metres, frame of t+1: origin of the ego frame of each sweep
    rows: tuple[slice, ...]  # for each given window, the slice of the P points that is its pc0
    # (K, 3) float32, metres, T_ego1_ego0 p - p of the K rows of all these pc0; 0 for points that are not finite
    pose_flow: Tensor
    ground: GroundHeights | None = None  # heights of the ground points of t; None = the method does not need them
    coverage: Coverage | None = None  # where each sweep measured; None = the method does not need it
    # (P,) float32, time of each point after the instant of its sweep, in sweep intervals, a multiple of 2^-20. 0 in a
    # window if one of its sweeps has no times of points. None = no window has them, or the method does not need them.
    point_times: Tensor | None = None

    @cached_property
    def chunks(self) -> list[Chunk]:
        """The points in chunks that suit the device: on a CPU those of one sweep, on a GPU those of many."""
        if self.image.device.type == "cpu":
            return list(self._chunks_of_sweeps())
        window, step = split_index(self.image.long(), self.num_steps)
        return [Chunk(points, window[points], step[points]) for points in chunks(0, len(window), self.image.device)]

    def _chunks_of_sweeps(self) -> Iterator[Chunk]:
        """Yield the points of each sweep alone."""
        ends = (flat_nonzero(self.image[1:] != self.image[:-1]) + 1).tolist()
        for start, stop in zip([0, *ends], [*ends, len(self.image)]):
            for points in chunks(start, stop, self.image.device):
                yield Chunk(points, *divmod(int(self.image[start]), self.num_steps))

    def with_empty_windows(self) -> Batch:
        """Append B windows without points, which have the same times and origins as the B windows of the batch."""
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
        windows: N windows, at least one, without older sweeps that the method ignores (`keep_nearest`).
        config: settings of a method.
        grid: grid of the images, of any scale; it contains the region.
        device: device of the batch.
        num_axes: coordinates to keep, 2 or 3.
        needs_ground: also keep the heights of the ground, and where each sweep measured.
        needs_times: also keep the times of the points.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, tensors on several devices, poses for some
            sweeps only, more sweeps after t+1 than `num_future`, time stamps out of order, poses too far apart.

    Cost: linear in points. The only Python loops are over sweeps, because these arrive as lists.
    """
    timeline = Timeline.of(windows, config, grid, needs_times)
    num_windows, num_steps = timeline.table.shape[1:]
    ground = GroundHeights(num_windows, grid.lower, grid.upper, device) if needs_ground else None
    coverage = Coverage(num_windows, num_steps, device) if needs_ground else None
    pieces = list(read_pieces(timeline, config, grid, device, num_axes, ground, coverage))
    point_times = [piece.point_times for piece in pieces if piece.point_times is not None]
    num_newest = sum(piece.image.numel() for piece in pieces if piece.step == 0)
    starts = list(accumulate([num_newest, *(window.pc0.points.shape[0] for window in windows)]))
    with torch.inference_mode(False):  # because the pose flow becomes part of the results
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
        has_pairs=bool(((timeline.table[0] != 0).sum(1) == 1).any()),
        elapsed=elapsed,
        seconds=seconds,
        origin=torch.stack(origin, 2),
        rows=tuple(slice(*ends) for ends in zip(starts, starts[1:])),
        pose_flow=pose_flow,
        ground=ground,
        coverage=coverage,
        point_times=torch.cat(point_times) if point_times else None,
    )
