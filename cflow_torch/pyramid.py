"""Coarse to fine, shared by all variants: estimate, warp the points by the flow so far, repeat at a finer pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, List, Optional, Sequence, Tuple

import torch
from torch import Tensor, nn
from torch.profiler import record_function

from cflow_torch.batch import Batch, make_batch, split_results, split_windows
from cflow_torch.config import Config, make_config
from cflow_torch.grid import Grid
from cflow_torch.types import CFlowError, FlowResult, Window


@dataclass(frozen=True)
class Motion:
    """What one scale found: clusters of points that share a flow. Entry M stands for "none": motion 0, id -1, score 0.

    Args:
        cluster: (P,) int32 or int64, cluster of every point, M = none.
        flow: (M + 1, 3) float64, metres per sweep interval, axes of ego1.
        cluster_id: (M + 1,) int64, number of the cluster counted from 0 in its window.
        score: (M + 1,) float32.
    """

    cluster: Tensor
    flow: Tensor
    cluster_id: Tensor
    score: Tensor


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
            flow: (P, 3) float64, metres per sweep interval, flow so far of every point of every sweep; None = none yet.
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
        for part in split_windows(windows, config, grids[-1]):
            results += self._flow(part, grids)
        return results

    def _flow(self, windows: Sequence[Window], grids: Sequence[Grid]) -> List[FlowResult]:
        with torch.inference_mode():  # a tenth faster than no_grad: the work is many small operations
            with record_function("compensate"):
                batch = make_batch(windows, self.config, grids[0], self.device)
            motion = self.motion_at_scale(batch, None, grids[0])
            flow = motion.flow.index_select(0, motion.cluster)
            for grid in grids[1:]:
                motion = self.motion_at_scale(batch, flow, grid)
                flow = flow + motion.flow.index_select(0, motion.cluster)
        # Outside of inference mode: results are ordinary tensors, which a training loop may use.
        with record_function("spread"):
            cluster_id = motion.cluster_id.index_select(0, motion.cluster)
            score = motion.score.index_select(0, motion.cluster)
            return split_results(batch, flow, cluster_id, score)


def project(batch: Batch, flow: Optional[Tensor], grid: Grid) -> Tuple[Tensor, Tensor, Tensor]:
    """Warp every sweep by the flow so far and project it (Eq. 3d_to_bev): sweep m moves by (t+1-m) times its flow.

    Args:
        batch: points of all windows.
        flow: (P, 3) float64, metres per sweep interval; None = no flow yet.
        grid: the BEV.

    Returns:
        positions: (3, P) float64, metres, frame of t+1.
        occupancy: (B, S, H, W) bool.
        pixel: (P,) int64, flat index into `occupancy`; its size for points that the flow moved out of the region.
    """
    with record_function("project"):
        positions, takes_part = batch.positions, None
        if flow is not None:
            k = batch.elapsed.flatten().index_select(0, batch.image)
            positions = positions + k * flow.t()
            takes_part = grid.contains(positions)
        occupancy, pixel = grid.project(positions, batch.image, batch.num_windows * batch.num_steps, takes_part)
        return positions, occupancy.unflatten(0, (batch.num_windows, batch.num_steps)), pixel
