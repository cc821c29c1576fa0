"""Coarse to fine, shared by all variants: estimate, warp the points by the flow so far, repeat at a finer pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, List, Optional, Sequence, Tuple

import torch
from torch import Tensor, nn
from torch.profiler import record_function

from cflow_torch.config import Config, make_config
from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.verified.rigid import RigidMotion
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch, make_batch, split_windows
from cflow_torch.windows.resolution import check_resolution
from cflow_torch.windows.validation import check_windows, choose_device


@dataclass(frozen=True)
class Motion:
    """What one scale found: clusters of points that share a flow. Entry M stands for "none": motion 0, id -1, score 0.

    Args:
        of_place: (Q,) int32 or int64, cluster of each place where a point can be, M = none.
        place: (P,) int64, place of every point: of a point that is left out, one that belongs to no cluster.
        flow: (M + 1, 3) float64, metres per sweep interval, axes of ego1.
        cluster_id: (M + 1,) int64, number of the cluster counted from 0 in its window.
        score: (M + 1,) float32.
        rigid: of M + 1, what `flow` says and a turn: only where one is found, and at the last scale only.
        confidence: (M + 1,) float32, see `FlowResult`; None = the method does not say.
    """

    of_place: Tensor
    place: Tensor
    flow: Tensor
    cluster_id: Tensor
    score: Tensor
    rigid: Optional[RigidMotion] = None
    confidence: Optional[Tensor] = None

    def cluster(self, points: slice) -> Tensor:
        """Cluster of each of some points, M = none."""
        return self.of_place.index_select(0, self.place[points])

    def flow_of(self, cluster: Tensor, out: Tensor) -> Tensor:
        """Into `out`, (A, K) float64: x, y (and z) of the flow of points of these K clusters."""
        for values, of_cluster in zip(out.unbind(0), self.flow.unbind(1)):
            torch.index_select(of_cluster, 0, cluster, out=values)
        return out


def turned_flow(flow: Tensor, rigid: RigidMotion, cluster: Tensor, positions: Tensor) -> Tensor:
    """(N, 3) float64 flow of points of t, each where it lies in a motion that turns.

    Args:
        flow: (M + 1, 3) float64, where nothing turns.
        rigid: of M + 1.
        cluster: (N,) cluster of each point, M = none.
        positions: (A, N) float64, metres; means nothing where there is no cluster.
    """
    flow = flow.index_select(0, cluster)
    turns = flat_nonzero((rigid.turn != 0).index_select(0, cluster))
    cluster, places = cluster.index_select(0, turns), positions[:2].index_select(1, turns)
    x, y = rigid.flow_at(cluster, *places.unbind(0))
    flow[turns, 0], flow[turns, 1] = x + 0.0, y + 0.0
    return flow


class CoarseToFine(nn.Module):
    """Windows in, flow out: the part that does not depend on how motion is found at one scale.

    A variant sets `method` and writes `motion_at_scale`. No parameters, no buffers, no state.

    Args:
        config: settings, see `Config`; `from_preset` makes them from a preset.
        device: "auto" = that of the tensors given, else a GPU if there is one, else the CPU.

    Raises:
        CFlowError: not a `Config`, or one of another method.

    Source: the paper's multi-scale strategy.
    """

    method = ""

    def __init__(self, config: Config, device: Any = "auto") -> None:
        super().__init__()
        name = type(self).__name__
        if not isinstance(config, Config):
            raise CFlowError(f"config is {type(config).__name__}: give a Config, or use {name}.from_preset")
        if config.method != self.method:
            raise CFlowError(f"{name} does method={self.method!r}, the config says {config.method!r}: use make_model")
        self.config = config
        self.device = device

    @classmethod
    def from_preset(cls, preset: str = "default", device: Any = "auto", **overrides: Any) -> CoarseToFine:
        """The method with the settings of a preset, some fields replaced.

        Raises:
            CFlowError: unknown preset or field, invalid value.
        """
        return cls(make_config(preset, **{"method": cls.method, **overrides}), device)

    def motion_at_scale(self, batch: Batch, flow: Optional[Tensor], grid: Grid) -> Motion:
        """Motion that is found at one pixel size.

        Args:
            batch: points of all windows.
            flow: (A, P) float64, metres per sweep interval, flow so far of every point before t+1; None = none yet.
            grid: the BEV at this scale.

        Returns:
            What this scale adds.
        """
        raise NotImplementedError

    @torch.no_grad()
    def forward(self, windows: Sequence[Window]) -> List[FlowResult]:
        """Flow t -> t+1 for the points of every window's pc0.

        Args:
            windows: B windows; numbers of points, sweeps and extents may differ.

        Returns:
            B results, each independent of the other windows.

        Raises:
            CFlowError: bad input, see `make_batch`.
        """
        config = self.config
        lower, upper = config.point_cloud_range[:3], config.point_cloud_range[3:]
        grids = [Grid(size, lower, upper) for size in config.pixel_sizes]
        results: List[FlowResult] = []
        check_windows(windows)
        check_resolution(windows, config)
        device = choose_device(windows, self.device)
        with torch.autocast(device.type, enabled=False):  # counts would lose bits
            for part in split_windows(windows, config, grids[-1], device):
                results += self._flow(part, grids, device)
        return results

    def _flow(self, windows: Sequence[Window], grids: Sequence[Grid], device: torch.device) -> List[FlowResult]:
        with torch.inference_mode():  # a tenth faster than no_grad: the work is many small operations
            with record_function("compensate"):
                batch = make_batch(windows, self.config, grids[0], device)
            motion, flow = self.motion_at_scale(batch, None, grids[0]), None
            for grid in grids[1:]:
                with record_function("spread"):
                    flow = _flow_so_far(batch, flow, motion)
                motion = self.motion_at_scale(batch, flow, grid)
        # Outside of inference mode: results are ordinary tensors, which a training loop may use.
        with record_function("spread"):
            return _results(batch, flow, motion)


def project(batch: Batch, flow: Optional[Tensor], grid: Grid) -> Tuple[Tensor, Tensor]:
    """Warp every sweep by the flow so far and project it (Eq. 3d_to_bev).

    Args:
        batch: points of all windows.
        flow: (A, P) float64, metres per sweep interval, see `warp`; None = no flow yet.
        grid: the BEV.

    Returns:
        occupancy: (B, S, H, W) bool.
        pixel: (P,) int64, flat index into `occupancy`; its size for points that do not take part.
    """
    with record_function("project"):
        num_images, num_points = batch.num_windows * batch.num_steps, len(batch.image)
        pixel = torch.empty(num_points, dtype=torch.int64, device=batch.image.device)
        for points in chunks(0, batch.num_newest, pixel.device):
            pixel[points] = grid.pixel_of_image(batch.positions[:, points], batch.image[points], num_images)
        for points in chunks(batch.num_newest, num_points, pixel.device):
            positions, takes_part = batch.positions[:, points], batch.takes_part[points]
            if flow is not None:
                positions = warp(batch, flow, points)
                takes_part = grid.contains(positions).logical_and_(takes_part)
            pixel[points] = grid.pixel_of_image(positions, batch.image[points], num_images, takes_part)
        return grid.draw(pixel, num_images).unflatten(0, (batch.num_windows, batch.num_steps)), pixel


def warp(batch: Batch, flow: Tensor, points: slice) -> Tensor:
    """Points before t+1 moved by the flow so far: sweep m by (t+1-m) times its flow.

    Args:
        batch: points of all windows.
        flow: (A, P) float64, metres per sweep interval; means nothing for points of t+1.
        points: which; none of t+1.

    Returns:
        (A, K) float64, metres, frame of t+1.
    """
    intervals = batch.elapsed.flatten().index_select(0, batch.image[points])
    return (flow[:, points] * intervals).add_(batch.positions[:, points])


def _flow_so_far(batch: Batch, flow: Optional[Tensor], motion: Motion) -> Tensor:
    """(A, P) float64, metres per sweep interval: the sum over the scales, of every point before t+1."""
    total = torch.empty_like(batch.positions) if flow is None else flow
    for points in chunks(batch.num_newest, len(batch.image), batch.image.device):
        part, cluster = total[:, points], motion.cluster(points)
        if flow is None:
            motion.flow_of(cluster, out=part)
        else:
            part += motion.flow_of(cluster, out=torch.empty_like(part))
    return total


def _results(batch: Batch, flow: Optional[Tensor], motion: Motion) -> List[FlowResult]:
    """One full-length result per window, for all rows of its pc0.

    Args:
        batch: as `make_batch` gives it.
        flow: of all scales but the last, as `_flow_so_far` gives it; None = there is only one.
        motion: what the last scale found.

    Returns:
        B results; rows that took no part have residual flow 0, cluster -1, score 0, is_valid False.
    """
    results = []
    for source in batch.sources:
        cluster = motion.cluster(source.points)
        if flow is None and motion.rigid is not None:
            residual = turned_flow(motion.flow, motion.rigid, cluster, batch.positions[:, source.points]).float()
        elif flow is None:
            residual = motion.flow.float().index_select(0, cluster)
        else:
            before = flow[:, source.points]
            residual = torch.zeros_like(source.pose_flow)
            total = motion.flow_of(cluster, out=torch.empty_like(before)).add_(before)
            for of_axis, values in zip(residual.unbind(1), total.unbind(0)):
                of_axis.copy_(values)
        cluster_id, score = (of_cluster.index_select(0, cluster) for of_cluster in (motion.cluster_id, motion.score))
        is_valid = batch.takes_part[source.points].clone()
        trust = motion.confidence
        if trust is not None:
            trust = trust.index_select(0, cluster).masked_fill_(~is_valid, 0.0)
        total_flow = residual + source.pose_flow
        results.append(FlowResult(residual, source.pose_flow, total_flow, cluster_id, score, is_valid, trust))
    return results
