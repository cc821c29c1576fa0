"""The points of a sweep that take part, and the groups of them that move, in the world frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cflow_torch.types import CFlowError, FlowResult, Window, as_numpy

MOVING = 0.05  # metres per sweep: residual flow of what moves, as in evaluation
MIN_POINTS = 5  # of a group


@dataclass(frozen=True)
class MovingGroups:
    """The points of a sweep that take part, in the world, and its G moving groups.

    Args:
        row: (M,) rows of the sweep; point, step: (M, 3) position and residual flow; group: (M,) -1 = does not move.
        cluster: (G,) cluster_id of each group; count: (G,) points; confidence: (G,).
    """

    row: Tensor
    point: Tensor
    step: Tensor
    group: Tensor
    cluster: Tensor
    count: Tensor
    confidence: Tensor

    @classmethod
    def of(cls, sweeps: Window, result: FlowResult) -> MovingGroups:
        """Those of the sweep t of a window and its flow.

        Raises:
            CFlowError: a result with another number of rows.
        """
        flow = result.residual_flow.double()
        points = torch.as_tensor(as_numpy(sweeps.pc0.points, np.float64)[:, :3].copy(), device=flow.device)
        if len(points) != len(flow):
            raise CFlowError(f"the flow has {len(flow)} rows, its sweep {len(points)} points: give its own window")
        row = (result.is_valid & points.isfinite().all(1)).nonzero()[:, 0]
        pose0, pose1 = (_pose(sweep.pose).to(flow.device) for sweep in (sweeps.pc0, sweeps.pc1))
        step = flow[row] @ pose1[:3, :3].T
        is_moving = (result.cluster_id[row] >= 0) & (step.norm(dim=1) >= MOVING)
        group = torch.full_like(row, -1)
        cluster, group[is_moving], count = torch.unique(
            result.cluster_id[row][is_moving], return_inverse=True, return_counts=True
        )
        number = torch.where(count >= MIN_POINTS, (count >= MIN_POINTS).cumsum(0) - 1, -1)
        group = torch.cat([number, number.new_full((1,), -1)])[group]
        cluster, count = cluster[number >= 0], count[number >= 0]
        given = flow.new_full((len(flow),), torch.nan) if result.confidence is None else result.confidence.double()
        seen = cls(row, points[row] @ pose0[:3, :3].T + pose0[:3, 3], step, group, cluster, count, count)
        return cls(**{**seen.__dict__, "confidence": seen.mean(given[row][:, None])[:, 0]})

    def mean(self, values: Tensor) -> Tensor:
        """(G, C) means over groups of (M, C)."""
        moves = self.group >= 0
        total = values.new_zeros(len(self.count), values.shape[1]).index_add_(0, self.group[moves], values[moves])
        return total / self.count[:, None]


def _pose(pose: Any) -> Tensor:
    return torch.eye(4, dtype=torch.float64) if pose is None else torch.as_tensor(as_numpy(pose, np.float64).copy())
