"""The scored points of a frame, the quantities that the metrics use, and sums of these quantities over frames."""

from __future__ import annotations

from typing import Any, NamedTuple, Sequence

import numpy as np

from cflow_torch.evaluation.definitions import Definition, interval_of
from cflow_torch.evaluation.frame import EvalFrame
from cflow_torch.transforms import transform_points
from cflow_torch.types import CFlowError, as_numpy

CLOSE_RANGE = 35.0  # metres, half side of the square that Argoverse 2 calls "close"


class ScoredPoints(NamedTuple):
    """The M scored points of one frame."""

    error: np.ndarray  # (M,) float64, metres, length of predicted minus true residual
    speed: np.ndarray  # (M,) float64, metres per frame, length of the true residual
    category: np.ndarray  # (M,) int64, Argoverse 2 index
    in_region: np.ndarray  # (M,) bool, inside the region of the definition
    # (M,) float64, metres, distance by which regions are measured: max(|x|, |y|) for a box, else the radius.
    reach: np.ndarray
    is_close: np.ndarray  # (M,) bool, inside the 70 m x 70 m square around the ego at t
    distance: np.ndarray  # (M,) float64, metres, from the origin at t, including height
    true_flow: np.ndarray  # (M, 3) float64, metres, true flow that the three-way scores compare
    predicted_flow: np.ndarray  # (M, 3) float64, metres, predicted flow that the three-way scores compare
    # (M,) bool, the true residual reaches the dynamic threshold, or the point is known to move (truth="motion").
    is_dynamic: np.ndarray
    predicted_dynamic: np.ndarray  # (M,) bool, whether the predicted residual reaches it
    num_nan: int  # number of points that are ignored because of NaN


class Accumulator:
    """Counts points and sums their quantities per cell, for example per class and speed bucket, in any order of frames.

    `count` is the int64 number of points of each cell. `sums` has a float64 array of the same shape per quantity.
    """

    def __init__(self, definition: Definition, shape: Sequence[int], num_quantities: int = 2) -> None:
        self.definition = definition
        self.count = np.zeros(shape, dtype=np.int64)
        self.sums = np.zeros((num_quantities, *shape), dtype=np.float64)

    def cells(self, scored: ScoredPoints) -> tuple[np.ndarray, Sequence[np.ndarray]]:
        """Return the flat cell of each scored point, (K,) int64, and its quantities, (K,) float64 each."""
        raise NotImplementedError

    def compute(self) -> dict[str, Any]:
        """Return the scores so far."""
        raise NotImplementedError

    def update_points(self, scored: ScoredPoints) -> None:
        """Add the scored points of one frame."""
        cell, quantities = self.cells(scored)
        size = self.count.size
        sums = np.stack([np.bincount(cell, values, minlength=size) for values in quantities])
        self._add(np.bincount(cell, minlength=size).reshape(self.count.shape), sums.reshape(self.sums.shape))

    def _add(self, count: np.ndarray, sums: np.ndarray) -> None:
        """Add the cells of one frame."""
        self.count += count
        self.sums += sums

    def merge(self, other: Accumulator) -> None:
        """Add the frames of another accumulator of the same kind and definition."""
        for name in vars(self).keys() - {"definition"}:
            setattr(self, name, getattr(self, name) + getattr(other, name))


def score_points(frame: EvalFrame, definition: Definition) -> ScoredPoints:
    """Select the points of a frame that a definition scores, and compare prediction and truth there.

    Rounding follows the evaluator that the definition is named after. Totals and residuals are float32. Like the
    evaluators, we add the pose flow to a predicted residual and subtract it again. We compute lengths in `norm_dtype`.
    Rows of unknown truth have no effect.
    """
    # Positions in the frame in which ranges are measured are float32 at t and float64 at t+1.
    points = as_numpy(frame.points)
    position = points if definition.region_axes == "t" else transform_points(points, frame.transform())
    keep = _candidates(frame, definition, position)
    flows = _Flows.of(frame)
    has_nan = flows.has_nan()
    num_nan = int((keep & has_nan).sum())
    if num_nan and definition.nan_rows == "error":
        raise CFlowError(
            f"{num_nan} scored points have NaN in position, truth or prediction, which definition {definition.name} "
            f"does not allow: predict 0 for points without an estimate, or use nan_rows='drop'"
        )
    keep &= ~has_nan
    flows = flows.at(keep)
    residual, true_residual = _residuals(frame, flows, keep, definition)
    predicted_flow = residual
    true_flow = true_residual
    if definition.three_way_flow == "total":
        predicted_flow = flows.total
        true_flow = flows.true_total
    if definition.half_precision:
        predicted_flow = predicted_flow.astype(np.float16)
        true_flow = true_flow.astype(np.float16)
    reach = _reach(position, definition)
    threshold = np.float32(definition.dynamic_threshold)
    is_dynamic = np.linalg.norm(true_residual, axis=1) >= threshold
    if definition.truth == "motion" and frame.moving is not None:
        is_dynamic |= as_numpy(frame.moving)[keep]
    predicted_dynamic = np.linalg.norm(flows.total - flows.pose_flow, axis=1) >= threshold
    if definition.truth == "motion" and frame.predicted_moving is not None:
        predicted_dynamic = as_numpy(frame.predicted_moving)[keep]
    difference = residual.astype(definition.norm_dtype) - true_residual.astype(definition.norm_dtype)
    return ScoredPoints(
        error=np.linalg.norm(difference, axis=1).astype(np.float64),
        speed=np.linalg.norm(true_residual.astype(definition.norm_dtype), axis=1).astype(np.float64),
        category=frame.labels.category[keep],
        in_region=(interval_of(reach, (0.0, definition.max_range), definition.closed) == 0)[keep],
        reach=reach[keep].astype(np.float64),
        is_close=(np.abs(flows.points[:, :2]) <= CLOSE_RANGE).all(axis=1),
        distance=np.linalg.norm(flows.points, axis=1).astype(np.float64),
        true_flow=true_flow.astype(np.float64),
        predicted_flow=predicted_flow.astype(np.float64),
        is_dynamic=is_dynamic,
        predicted_dynamic=predicted_dynamic,
        num_nan=num_nan,
    )


class _Flows(NamedTuple):
    """Positions and flow of the points of a frame, (N, 3) each; the flow has the axes of t+1."""

    points: np.ndarray  # of t
    pose_flow: np.ndarray
    total: np.ndarray  # predicted
    true_total: np.ndarray

    @classmethod
    def of(cls, frame: EvalFrame) -> _Flows:
        """Read all rows of a frame."""
        pose_flow = as_numpy(frame.pose_flow)  # type: ignore[arg-type]
        return cls(as_numpy(frame.points), pose_flow, _predicted_total(frame), frame.labels.flow)

    def has_nan(self) -> np.ndarray:
        """(N,) bool, whether each row has NaN."""
        return np.isnan(np.concatenate(self, axis=1)).any(axis=1)

    def at(self, keep: np.ndarray) -> _Flows:
        """Select rows, (N,) bool."""
        return _Flows(*(values[keep] for values in self))


def _residuals(
    frame: EvalFrame, flows: _Flows, keep: np.ndarray, definition: Definition
) -> tuple[np.ndarray, np.ndarray]:
    """Return the predicted and the true residual flow of the scored points, (M, 3) float32 each."""
    if definition.residual_axes != "t":
        return flows.total - flows.pose_flow, flows.true_total - flows.pose_flow
    T = frame.transform()
    true_residual = _residual_at_t(flows.points, flows.true_total, T)
    if frame.residual_flow is None:
        return _residual_at_t(flows.points, flows.total, T), true_residual
    # A residual that the frame already has needs only a rotation.
    stored = as_numpy(frame.residual_flow)[keep]
    return stored if frame.residual_axes == "t" else (stored @ T[:3, :3]).astype(np.float32), true_residual


def _reach(position: np.ndarray, definition: Definition) -> np.ndarray:
    """Return the distance by which regions are measured, (N,) metres, of (N, 3) positions."""
    if definition.region == "box":
        return np.abs(position[:, :2]).max(axis=1)
    return np.linalg.norm(position[:, :2], axis=1)


def _predicted_total(frame: EvalFrame) -> np.ndarray:
    """Return the (N, 3) float32 predicted total flow, axes of t+1."""
    if frame.flow is not None:
        return as_numpy(frame.flow)
    residual = as_numpy(frame.residual_flow)  # type: ignore[arg-type]
    if frame.residual_axes == "t":
        residual = (residual @ frame.transform()[:3, :3].T).astype(np.float32)
    return as_numpy(frame.pose_flow) + residual  # type: ignore[arg-type]


def _residual_at_t(points: np.ndarray, total: np.ndarray, T_ego1_ego0: np.ndarray) -> np.ndarray:
    """Return the (M, 3) float32 residual in the axes of t: end point in coordinates of t, minus the start point."""
    start = points.astype(np.float64)
    rotation = T_ego1_ego0[:3, :3]
    translation = T_ego1_ego0[:3, 3]
    return ((start + total - translation) @ rotation - start).astype(np.float32)


def _candidates(frame: EvalFrame, definition: Definition, position: np.ndarray) -> np.ndarray:
    """Return (N,) bool: known truth, not ground, inside the evaluation mask and the crop."""
    keep = frame.labels.is_valid.copy()
    if definition.truth == "motion" and frame.moving is not None:
        keep |= as_numpy(frame.moving)
    if definition.ground == "ignored" and frame.is_ground is not None:
        keep &= ~as_numpy(frame.is_ground)
    if frame.eval_mask is not None:
        keep &= as_numpy(frame.eval_mask)
    elif definition.mask_box is not None:
        keep &= (np.abs(as_numpy(frame.points)[:, :2]) <= definition.mask_box).all(axis=1)
    if definition.point_cloud_range is not None:
        crop = np.asarray(definition.point_cloud_range, dtype=np.float64)
        keep &= ((position > crop[:3]) & (position < crop[3:])).all(axis=1)
    return keep
