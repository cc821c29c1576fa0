"""The content of a viewer for a pair of sweeps: `recording` and `page` draw the same points, arrows and boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Mapping

import numpy as np

from cflow_torch.data.log import FlowLabels
from cflow_torch.types import CENTRE, CFlowError, FlowResult, Sweep, as_numpy, point_rows, vectors
from cflow_torch.viz.panel import MIN_ARROW_POINTS, group_medians
from cflow_torch.viz.style import SWEEP_RATE

MAX_FLOW = 1.5  # metres per sweep: 15 m/s at 10 Hz


@dataclass(frozen=True)
class ViewedPair:
    """One pair, without NaN and infinite points."""

    index: int  # of sweep t
    timestamp_ns: int | None  # of sweep t, None = unknown
    interval: float  # seconds from t to t+1
    position: np.ndarray  # (N, 3) float64, metres, points of t in the ego frame of t+1: moved by the ego motion only
    residual: np.ndarray  # (N, 3) float64, metres per sweep
    truth: np.ndarray | None  # (N, 3) float64, true residual flow, NaN where unknown; None = the pair has no labels
    cluster: np.ndarray  # (N,) int64, -1 = none
    confidence: np.ndarray | None  # (N,) float64, or None
    moving: np.ndarray | None  # (N,) float64, probability that a point moves, or None
    is_moving: np.ndarray  # (N,) bool, see `FlowResult.is_moving`
    is_ground: np.ndarray  # (N,) bool
    pose: np.ndarray | None  # (4, 4) float64 `T_world_ego` of t+1, or None

    @classmethod
    def of(cls, index: int, pc0: Sweep, pc1: Sweep, result: FlowResult, labels: FlowLabels | None) -> ViewedPair:
        """Make the scene of sweeps t and t+1, from the flow of all points of t and, if there are any, labels."""
        points = as_numpy(pc0.points, np.float64)[:, :3]
        rows = len(result.residual_flow)
        if rows != len(points):
            raise CFlowError(f"pair {index}: the flow has {rows} rows, its sweep {len(points)} points")
        pose_flow = as_numpy(result.pose_flow, np.float64)
        position = points + pose_flow
        kept = np.isfinite(position).all(axis=1)
        ground = np.zeros(rows, bool) if pc0.is_ground is None else as_numpy(pc0.is_ground).astype(bool)
        truth = None
        times = (pc0.timestamp_ns, pc1.timestamp_ns)
        if labels is not None:
            true_flow = point_rows(f"pair {index}: the flow of the labels", labels.flow, rows)
            truth = np.where(as_numpy(labels.is_valid)[:, None], true_flow - pose_flow, np.nan)[kept]
        return cls(
            index=index,
            timestamp_ns=times[0],
            interval=_interval(*times),
            position=position[kept],
            residual=as_numpy(result.residual_flow, np.float64)[kept],
            truth=truth,
            cluster=as_numpy(result.cluster_id)[kept],
            confidence=None if result.confidence is None else as_numpy(result.confidence, np.float64)[kept],
            moving=None if result.moving is None else as_numpy(result.moving, np.float64)[kept],
            is_moving=as_numpy(result.is_moving)[kept],
            is_ground=ground[kept],
            pose=None if pc1.pose is None else as_numpy(pc1.pose, np.float64),
        )

    def arrows(self, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return ids, (A,), median positions and flows, (A, 3), of clusters with enough points that move, (N,) bool."""
        moving = ~self.is_ground & moves
        columns = np.concatenate([self.position[moving], self.residual[moving]], axis=1)
        cluster, middle, count = group_medians(self.cluster[moving], columns)
        large = count >= MIN_ARROW_POINTS
        return cluster[large], middle[large, :3], middle[large, 3:]


def _interval(begin: int | None, end: int | None) -> float:
    return 1 / SWEEP_RATE if begin is None or end is None or end <= begin else (end - begin) * 1e-9


class ViewerFrame:
    """The ego frame at t+1 of the first pair with poses. Viewers use float32, so points must be near their origin."""

    def __init__(self) -> None:
        self.T_world_viewer: np.ndarray | None = None

    def move(self, pose: np.ndarray) -> np.ndarray:
        """Return (4, 4) `T_viewer_ego`, given a pose `T_world_ego`. The first pose becomes the frame of the viewer."""
        if self.T_world_viewer is None:
            self.T_world_viewer = pose
        return np.linalg.solve(self.T_world_viewer, pose)

    def boxes(self, tracks: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return centres (K, 3), metres, and headings (K,), radians, of rows of a table of `cflow_torch.track`."""
        T_viewer_world = np.eye(4) if self.T_world_viewer is None else np.linalg.inv(self.T_world_viewer)
        centre = vectors(tracks, CENTRE) @ T_viewer_world[:3, :3].T + T_viewer_world[:3, 3]
        return centre, tracks["heading"] + np.arctan2(T_viewer_world[1, 0], T_viewer_world[0, 0])
