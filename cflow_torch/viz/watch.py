"""A run of the model on one window with a note of what passes from scale to scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Tuple, Type

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.keypoints.method import CorrelationFlowKeypoints
from cflow_torch.model import CoarseToFine, Motion, project
from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.collation import Batch


@dataclass(frozen=True)
class Occupancy:
    """BEV images of a pair of sweeps.

    Args:
        t, t1: (H, W) bool, sweep t moved by the flow so far, and sweep t+1; row from y, column from x.
        lower: (2,) float64, metres, corner (x, y) of pixel (0, 0), frame of t+1.
        pixel_size: metres.
    """

    t: np.ndarray
    t1: np.ndarray
    lower: np.ndarray
    pixel_size: float


@dataclass(frozen=True)
class Step:
    """What one scale was given, and what it found.

    Args:
        batch: points of the one window.
        flow: (A, P) float64, metres per sweep interval, flow so far; None = this is the first scale.
        grid: the BEV at this scale.
        motion: what it adds.
    """

    batch: Batch
    flow: Optional[Tensor]
    grid: Grid
    motion: Motion

    def flow_after(self) -> Tensor:
        """(A, P) float64, metres per sweep interval: flow so far with this scale's; 0 for points of t+1."""
        points = slice(self.batch.num_newest, None)
        total = torch.zeros_like(self.batch.positions)
        self.motion.flow_of(self.motion.cluster(points), out=total[:, points])
        if self.flow is not None:
            total[:, points] += self.flow[:, points]
        return total

    def occupancy(self, flow: Optional[Tensor]) -> Occupancy:
        """The pair at this scale, points warped by a flow as `project` takes it."""
        (images,), _ = project(self.batch, flow, self.grid)
        t1, t = images[:2].numpy()
        return Occupancy(t, t1, np.array(self.grid.lower[:2]), self.grid.pixel_size)


def watch(window: Window, config: Config) -> Tuple[List[Step], FlowResult]:
    """Run the method on one window, on the CPU, and keep what passes from scale to scale."""
    if config.proof:
        raise CFlowError(
            "with proof=True (presets default and fast) motions are hypotheses of all scales at once: there is no "
            'single correlation map and no coarse to fine to draw. Give make_config("paper"), or model=paper'
        )
    steps: List[Step] = []
    variant: Type[CoarseToFine] = CorrelationFlowKeypoints if config.method == "keypoints" else CorrelationFlow

    class Watched(variant):  # type: ignore[valid-type,misc]
        def motion_at_scale(self, batch: Batch, flow: Optional[Tensor], grid: Grid) -> Motion:
            motion = super().motion_at_scale(batch, flow, grid)
            steps.append(Step(batch, None if flow is None else flow.clone(), grid, motion))
            return motion

    (result,) = Watched(config, "cpu")([window])
    return steps, result
