"""A run of the model on one window with a note of what passes from scale to scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import List, Optional, Tuple, Type

import numpy as np
import torch
from torch import Tensor

from cflow_torch.config import Config
from cflow_torch.dense.coarse_to_fine import CoarseToFine
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.dense.projection import ProjectedSweeps, project
from cflow_torch.keypoints.method import CorrelationFlowKeypoints
from cflow_torch.model import Motion
from cflow_torch.types import CFlowError, FlowResult, Window


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
        sweeps: the one window, warped by the flow so far.
        flow: (A, P) float64, metres per sweep interval, flow so far; None = this is the first scale.
        motion: what it adds.
    """

    sweeps: ProjectedSweeps
    flow: Optional[Tensor]
    motion: Motion

    def flow_after(self) -> Tensor:
        """(A, P) float64, metres per sweep interval: flow so far with this scale's; 0 for points of t+1."""
        batch = self.sweeps.batch
        points = slice(batch.num_newest, None)
        total = torch.zeros_like(batch.positions)
        self.motion.flow_of(self.motion.cluster(points), out=total[:, points])
        if self.flow is not None:
            total[:, points] += self.flow[:, points]
        return total

    def occupancy(self, flow: Optional[Tensor]) -> Occupancy:
        """The pair at this scale, points warped by a flow as `project` takes it."""
        grid = self.sweeps.grid
        (images,) = project(self.sweeps.batch, flow, grid).occupancy
        t1, t = images[:2].numpy()
        return Occupancy(t, t1, np.array(grid.lower[:2]), grid.pixel_size)


def watch(window: Window, config: Config) -> Tuple[List[Step], FlowResult]:
    """Run the method on one window, on the CPU, and keep what passes from scale to scale."""
    if config.method == "verified":
        raise CFlowError(
            "presets default and fast weigh motions of all scales at once: there is no single correlation map and no "
            'coarse to fine to draw. Give make_config("paper"), or model=paper'
        )
    steps: List[Step] = []
    variant: Type[CoarseToFine] = CorrelationFlowKeypoints if config.method == "keypoints" else CorrelationFlow

    class Watched(variant):  # type: ignore[valid-type,misc]
        def motion_at_scale(self, sweeps: ProjectedSweeps) -> Motion:
            motion = super().motion_at_scale(sweeps)
            steps.append(Step(sweeps, None if sweeps.flow is None else sweeps.flow.clone(), motion))
            return motion

    (result,) = Watched(config, "cpu")([window])
    return steps, result
