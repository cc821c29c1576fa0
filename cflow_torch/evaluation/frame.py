"""One frame to score: points, prediction and truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from cflow_torch.data.hdf5.frames import StoredMotion, harness_pose_flow, residual_for_harness
from cflow_torch.data.log import FlowLabels
from cflow_torch.transforms import transform_points
from cflow_torch.types import Array, CFlowError, FlowResult, Window, as_numpy, point_rows


def ego_motion_flow(points: np.ndarray, T_ego1_ego0: np.ndarray) -> np.ndarray:
    """Compute the flow of static (N, 3) points of t, T p - p: (N, 3) float32, metres, axes of ego1.

    We compute in float64 and round once, because the difference of two float32 positions at 100 m has 1e-5 m of noise.
    """
    return (transform_points(points, np.asarray(T_ego1_ego0, np.float64)) - points).astype(np.float32)


@dataclass(frozen=True)
class EvalFrame:
    """One pair of sweeps with its prediction and truth, as arrays or tensors.

    Rows are the points of sweep t in their order, ground included.

    Args:
        points: (N, 3+) float, metres, ego frame of t.
        labels: truth of the pair (total flow, categories, valid rows).
        residual_flow: (N, 3) float, predicted residual, metres per sweep. Give this or `flow`, not both.
        flow: (N, 3) float, predicted total flow, axes of ego1.
        pose_flow: (N, 3) float, T_ego1_ego0 p - p; None = computed from `T_ego1_ego0`. Give at least one of the two.
        T_ego1_ego0: (4, 4) float, maps ego coordinates of t to those of t+1. Definitions with `region_axes="t+1"`
            or `residual_axes="t"` need it, and so does a `residual_flow` in the axes of t.
        is_ground: (N,) bool, True = ground; None = no point is ground.
        eval_mask: (N,) bool, True = scored; None = all.
        moving: (N,) bool, True = the point moves, even if its flow is unknown. Definitions with `truth="motion"` use
            it; None = points move by their true flow.
        predicted_moving: (N,) bool, True = the point is predicted to move. Definitions with `truth="motion"` use it;
            None = points move by their predicted flow.
        residual_axes: axes of `residual_flow`, "t+1" or "t". This package predicts in "t+1".

    Convention: everything is checked and converted to NumPy in the constructor.

    Raises:
        CFlowError: missing or contradictory parts, shapes that do not agree.
    """

    points: Array
    labels: FlowLabels
    residual_flow: Array | None = None
    flow: Array | None = None
    pose_flow: Array | None = None
    T_ego1_ego0: Array | None = None
    is_ground: Array | None = None
    eval_mask: Array | None = None
    moving: Array | None = None
    predicted_moving: Array | None = None
    residual_axes: str = "t+1"

    def __post_init__(self) -> None:
        if (self.residual_flow is None) == (self.flow is None):
            raise CFlowError("give an evaluation frame exactly one of residual_flow and flow (total)")
        if self.pose_flow is None and self.T_ego1_ego0 is None:
            raise CFlowError(
                "give an evaluation frame pose_flow or T_ego1_ego0, to separate ego motion and object motion"
            )
        if self.residual_axes not in ("t", "t+1"):
            raise CFlowError(f"residual_axes={self.residual_axes!r}: give 't' or 't+1'")
        points = point_rows("points", self.points)
        labels = self.labels
        rows = len(points)
        self._set("points", points.astype(np.float32))
        for name, dtype, shape in (
            *((name, np.float32, (rows, 3)) for name in ("residual_flow", "flow", "pose_flow")),
            *((name, np.bool_, (rows,)) for name in ("is_ground", "eval_mask", "moving", "predicted_moving")),
            ("T_ego1_ego0", np.float64, (4, 4)),
        ):
            self._set(name, _checked(name, getattr(self, name), dtype, shape))
        true_flow = _checked("labels.flow", labels.flow, np.float32, (rows, 3))
        truth = FlowLabels(true_flow, as_numpy(labels.category, np.int64), as_numpy(labels.is_valid))
        self._set("labels", truth)
        if self.pose_flow is None:
            self._set("pose_flow", ego_motion_flow(self.points, self.T_ego1_ego0))  # type: ignore[arg-type]

    @classmethod
    def from_result(
        cls,
        window: Window,
        result: FlowResult,
        labels: FlowLabels,
        stored_motion: StoredMotion | None = None,
        **parts: Any,
    ) -> EvalFrame:
        """Make a frame from a window and the flow that was estimated for it.

        Args:
            window: with the poses of both pc0 and pc1, or of neither.
            result: flow of `window.pc0`.
            labels: truth of the pair.
            stored_motion: ego motion as OpenSceneFlow uses it (`HDF5Log.stored_motion`). We subtract it from truth and
                prediction with OpenSceneFlow's rounding. None = motion of the window.
            **parts: further fields, for example `eval_mask`. They take precedence over those of the window.
        """
        pose0 = window.pc0.pose
        pose1 = window.pc1.pose
        if pose0 is not None and pose1 is not None:
            parts.setdefault("T_ego1_ego0", np.linalg.inv(as_numpy(pose1, np.float64)) @ as_numpy(pose0, np.float64))
        parts.setdefault("is_ground", window.pc0.is_ground)
        parts.setdefault("predicted_moving", result.is_moving)
        if stored_motion is not None:
            points = torch.as_tensor(as_numpy(window.pc0.points)[:, :3])
            residual = result.residual_flow.cpu()
            if not stored_motion.of_points:
                residual = residual_for_harness(residual, points, stored_motion.T_ego1_ego0, parts["T_ego1_ego0"])
            pose_flow = harness_pose_flow(points, stored_motion.T_ego1_ego0)
            parts.update(T_ego1_ego0=stored_motion.T_ego1_ego0, pose_flow=pose_flow, flow=pose_flow + residual)
            return cls(points=points, labels=labels, **parts)
        # The labels have the ego motion of the given poses. `result.pose_flow` may be that of corrected ones.
        if "T_ego1_ego0" not in parts:  # without poses, the ego vehicle does not move
            parts.setdefault("pose_flow", np.zeros_like(labels.flow))
        parts.setdefault("residual_flow", result.residual_flow)
        return cls(points=window.pc0.points, labels=labels, **parts)

    def transform(self) -> np.ndarray:
        """Return T_ego1_ego0, (4, 4) float64. A frame that has only `pose_flow` raises a `CFlowError`."""
        if self.T_ego1_ego0 is None:
            raise CFlowError("this definition measures in another frame: pass T_ego1_ego0 to the evaluation frame")
        return as_numpy(self.T_ego1_ego0)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)


def _checked(name: str, value: Any, dtype: Any, shape: tuple[int, ...]) -> Any:
    """Convert an array to its dtype and check its shape; None stays None."""
    if value is None:
        return None
    array = as_numpy(value)
    if array.shape != shape:
        raise CFlowError(f"{name} must have shape {shape} (one row per point of sweep t), got {array.shape}")
    return array.astype(dtype)
