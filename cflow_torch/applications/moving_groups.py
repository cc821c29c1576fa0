"""The valid points of a sweep and its moving groups, in the world frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cflow_torch.ops.indices import unique_pairs
from cflow_torch.transforms import transform_points
from cflow_torch.types import MOVING as MOVING
from cflow_torch.types import CFlowError, FlowResult, Sweep, Window, as_numpy

MIN_POINTS = 5  # of a group, at least


@dataclass(frozen=True)
class MovingGroups:
    """The M valid points of a sweep (`is_valid`), in the world, and its G moving groups."""

    row: Tensor  # (M,) int64 rows of the sweep
    point: Tensor  # (M, 3) float64 position, metres
    step: Tensor  # (M, 3) float64 residual flow, metres
    group: Tensor  # (M,) int64, -1 = static
    cluster: Tensor  # (G,) int64 cluster_id of each group
    count: Tensor  # (G,) int64 number of points of each group
    confidence: Tensor  # (G,) float64 mean over its points, NaN where the method has none

    @classmethod
    def of(cls, sweeps: Window, result: FlowResult) -> MovingGroups:
        """Find the moving groups of sweep t of a window; a flow with another number of rows is a `CFlowError`."""
        flow = result.residual_flow.double()
        points = torch.as_tensor(as_numpy(sweeps.pc0.points, np.float64)[:, :3].copy(), device=flow.device)
        if len(points) != len(flow):
            raise CFlowError(
                f"the flow has {len(flow)} rows, its sweep {len(points)} points: give the flow of this window"
            )
        row = (result.is_valid & points.isfinite().all(1)).nonzero()[:, 0]
        pose0, pose1 = (torch.tensor(pose_of(sweep), device=flow.device) for sweep in (sweeps.pc0, sweeps.pc1))
        point = points[row] @ pose0[:3, :3].T + pose0[:3, 3]
        step = flow[row] @ pose1[:3, :3].T
        cluster_of_point = result.cluster_id[row]
        # Tracks ask for motion over several sweeps, which tells more than the P(moving) of one: groups by `is_moving`
        # cost 4 to 13 % of the moving objects of simulated drives.
        is_moving = (cluster_of_point >= 0) & (step.norm(dim=1) >= MOVING)
        cluster, index, count = torch.unique(cluster_of_point[is_moving], return_inverse=True, return_counts=True)
        is_large = count >= MIN_POINTS
        group = torch.full_like(row, -1)
        group[is_moving] = torch.where(is_large, is_large.cumsum(0) - 1, -1)[index]
        confidence = flow.new_full((len(flow),), torch.nan)
        if result.confidence is not None:
            confidence = result.confidence.double()
        groups = cls(row, point, step, group, cluster[is_large], count[is_large], count)
        return replace(groups, confidence=groups.mean(confidence[row][:, None])[:, 0])

    @property
    def moves(self) -> Tensor:
        """(M,) bool, points of moving groups."""
        return self.group >= 0

    @property
    def moving(self) -> tuple[Tensor, Tensor]:
        """Positions, (P, 3), and groups, (P,), of the points of moving groups."""
        return self.point[self.moves], self.group[self.moves]

    def divide(self, piece: Tensor) -> MovingGroups:
        """Divide groups by the piece of each point, (M,) int64, -1 = now static. Pieces keep cluster and confidence."""
        moves = self.moves & (piece >= 0)
        origin, _, index, count = unique_pairs(self.group[moves], piece[moves])
        group = torch.full_like(self.group, -1).masked_scatter(moves, index)
        confidence = self.confidence[origin]
        return replace(self, group=group, cluster=self.cluster[origin], count=count, confidence=confidence)

    def mean(self, values: Tensor) -> Tensor:
        """Return the (G, C) means of the (M, C) values of points over each group."""
        total = values.new_zeros(len(self.count), values.shape[1])
        return total.index_add_(0, self.group[self.moves], values[self.moves]) / self.count[:, None]


def pose_of(sweep: Sweep) -> np.ndarray:
    """(4, 4) float64 `T_world_ego` of a sweep; the identity if it has no pose."""
    return np.eye(4) if sweep.pose is None else as_numpy(sweep.pose, np.float64)


def world_points(sweep: Sweep, rows: Any = ...) -> np.ndarray:
    """(N, 3) float64 points of a sweep, or those of some rows, metres, in the world."""
    return transform_points(as_numpy(sweep.points)[rows, :3], pose_of(sweep))
