"""One flow result -> the columns of a submission file, and what float16 costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cflow_torch.evaluation.submission.versions import SubmissionVersion
from cflow_torch.types import CFlowError, FlowResult, Window, as_numpy
from cflow_torch.windows.ego_motion import relative_transform

DYNAMIC_THRESHOLD = 0.05  # metres per sweep; as the evaluation's dynamic points
LARGEST = float(np.finfo(np.float16).max)  # 65504 m
RESIDUAL_AXES = ("t+1", "t")


@dataclass
class Rounding:
    """What was lost to float16: lengths of the differences, metres.

    Args:
        largest, total: of one point, of all points together.
        num_points: points counted.
    """

    largest: float = 0.0
    total: float = 0.0
    num_points: int = 0

    def add(self, other: Rounding) -> None:
        """Count another file's points as well."""
        self.largest = max(self.largest, other.largest)
        self.total += other.total
        self.num_points += other.num_points

    @property
    def mean(self) -> float:
        """Of one point, metres; 0 without points."""
        return self.total / self.num_points if self.num_points else 0.0

    def __str__(self) -> str:
        return f"largest {self.largest:.6f} m, mean {self.mean:.8f} m over {self.num_points:,} points"


def encode(
    version: SubmissionVersion,
    sweeps: Window,
    result: FlowResult,
    mask: np.ndarray | None = None,
    residual_axes: str = "t+1",
) -> tuple[dict[str, np.ndarray], Rounding]:
    """Columns of one frame's file.

    Args:
        version: the format.
        sweeps: the window; its pc0 gives the ground, its poses turn the residual if `residual_axes` is "t".
        result: flow of `sweeps.pc0`.
        mask: (N,) bool, points to write; needed where the format asks for masked rows, refused elsewhere.
        residual_axes: axes of the residual in the file. "t+1", as OpenSceneFlow writes it; "t" as
            bucketed-scene-flow-eval measures it.

    Returns:
        Columns by name, in the format's order (flow float16, metres until the next sweep; `is_dynamic`, `is_valid`
        bool), and the rounding.

    Convention:
        Residuals of ground points are 0. `is_dynamic`: unrounded residual of 0.05 m or more. `is_valid`: every row,
        because bucketed-scene-flow-eval refuses predictions that leave out a point it scores.

    Raises:
        CFlowError: no mask, or one too many; a value is NaN, infinite or beyond float16; unknown axes.
    """
    if (mask is not None) != (version.rows == "masked"):
        raise CFlowError(f"version {version.number} holds {version.rows} rows: give a mask for masked ones alone")
    residual = as_numpy(result.residual_flow).astype(np.float32)
    keep = np.ones(len(residual), dtype=bool) if mask is None else np.asarray(mask, dtype=bool)
    axes = RESIDUAL_AXES[:1] if version.flow == "total" else RESIDUAL_AXES
    if residual_axes not in axes:
        raise CFlowError(
            f"residual_axes of version {version.number} is one of {', '.join(axes)}, got {residual_axes!r}"
        )
    if version.flow == "total":
        flow = as_numpy(result.flow).astype(np.float32)
    else:
        flow = _turned(residual, sweeps, residual_axes)
        if sweeps.pc0.is_ground is not None:
            flow[as_numpy(sweeps.pc0.is_ground)] = 0.0
    half, rounding = to_half(flow[keep])
    columns = {
        "is_valid": np.ones(len(half), dtype=bool),
        "is_dynamic": np.linalg.norm(residual[keep], axis=1) >= np.float32(DYNAMIC_THRESHOLD),
        **{f"flow_t{axis}_m": half[:, i] for i, axis in enumerate("xyz")},
    }
    return {name: columns[name] for name in version.columns}, rounding


def to_half(flow: np.ndarray) -> tuple[np.ndarray, Rounding]:
    """(M, 3) flow of any float type in float16, and what was lost.

    Raises:
        CFlowError: a value is NaN, infinite, or larger than float16 can hold.
    """
    bad = ~(np.abs(flow) <= LARGEST).all(axis=1)
    if bad.any():
        raise CFlowError(f"the flow of {bad.sum()} points is NaN, infinite or beyond float16 ({LARGEST:g} m)")
    half = flow.astype(np.float16)
    lost = np.linalg.norm(half.astype(np.float64) - flow.astype(np.float64), axis=1)
    return half, Rounding(float(lost.max(initial=0.0)), float(lost.sum()), len(lost))


def _turned(residual: np.ndarray, sweeps: Window, axes: str) -> np.ndarray:
    """(N, 3) float32 residual in the axes asked for; a copy."""
    pose0, pose1 = sweeps.pc0.pose, sweeps.pc1.pose
    if axes == "t+1" or pose0 is None or pose1 is None:  # without poses both sweeps lie in one frame
        return residual.copy()
    return (residual.astype(np.float64) @ relative_transform(pose1, pose0)[:3, :3]).astype(np.float32)
