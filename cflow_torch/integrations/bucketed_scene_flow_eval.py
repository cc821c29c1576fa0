"""An estimator for BucketedSceneFlowEval: it takes frames and returns `EgoLidarFlow`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Sequence

import numpy as np

from cflow_torch.errors import import_optional
from cflow_torch.integrations.sequence import SequenceFlow, SequenceSweep, times_in_ns
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import CFlowError, check_array


class CorrelationFlowEstimator(SequenceFlow):
    """Estimates flow for the frames of a data set of BucketedSceneFlowEval (2.0.25).

    The arguments are those of `SequenceFlow`, for example `num_history=2`.
    """

    def forward(self, frames: Sequence[Any]) -> list[Any]:
        """Estimate the flow of every frame but the last.

        Args:
            frames: K >= 2 consecutive `TimeSyncedSceneFlowFrame` (or raw frames) of one log, in order of time, such as
                an item of a data set.

        Returns:
            K - 1 `EgoLidarFlow`. Flow i has a row for each point of `frames[i].pc.full_pc`, in their order. The frames
            before i, at most `num_history`, are its history.
            full_flow: (N, 3) float32, metres until frame i + 1, residual (ego motion removed), in the axes of the
                points of frame i. It is 0 for inactive points and outside `point_cloud_range`.
            mask: the frame's own `pc.mask`. A flow of 0 outside the method's range is scored like any other.

        Convention:
            A point is active if `pc.mask` is True (not ground, in the range of the data set). A `CFlowError` names a
            bad field ("frames[1].pc.mask").
        """
        return self._ego_flows(_read_frames(frames), 0)

    def evaluate(self, dataset: Any) -> Any:
        """Estimate and score all frames that an `AbstractDataset` scores.

        A causal data set scores the frame before the last of each item, a non-causal one every frame but the last.
        If items overlap (a causal data set, step 1), frames of earlier items are history of later ones. With
        `subsequence_length=2`, every frame of a log but its last is scored, the first ones with a shorter history.

        Returns:
            `dataset.evaluator()` with all flows added. Call its `compute_results()`.
        """
        evaluator = dataset.evaluator()
        is_causal = dataset.loader_type().name == "CAUSAL"
        known: list[_LogFrame] = []
        for number in range(len(dataset)):
            item = dataset[number]
            frames = _read_frames(item)
            older = _earlier(known, frames[0], self.num_history)
            known = [*older, *frames]
            first = len(item) - 2 if is_causal else 0
            for frame, flow in zip(item[first:], self._ego_flows(known, len(older) + first)):
                evaluator.eval(flow, frame)
        return evaluator

    def _ego_flows(self, frames: Sequence[_LogFrame], first: int) -> list[Any]:
        need = "this needs pip install 'bucketed-scene-flow-eval>=2.0.25', which needs Python 3.10 and open3d"
        flow_class = import_optional("bucketed_scene_flow_eval.datastructures", need, "EgoLidarFlow")
        (flows,) = self.flows([frames], [first])
        return [
            flow_class(full_flow=flow.cpu().numpy(), mask=np.array(frame.is_active))  # a copy: the evaluator changes it
            for flow, frame in zip(flows, frames[first:])
        ]


@dataclass(frozen=True)
class _LogFrame(SequenceSweep):
    """A frame with the id of its log and its index in this log."""

    log_id: str = ""
    log_idx: int = 0


def _read_frames(frames: Any) -> list[_LogFrame]:
    """Read and check the frames of one log. Any class with the same fields is accepted."""
    if not isinstance(frames, (list, tuple)) or len(frames) < 2 or isinstance(frames[0], tuple):
        raise CFlowError("frames: give a list of at least two frames of one log, such as an item of a data set")
    stamps = times_in_ns([frame.log_timestamp for frame in frames])
    read = [_read_frame(f"frames[{i}]", *pair) for i, pair in enumerate(zip(frames, stamps))]
    for i, (old, new) in enumerate(zip(read, read[1:]), 1):
        if (new.log_id, new.log_idx) != (old.log_id, old.log_idx + 1):
            found = f"{new.log_id!r}, {new.log_idx} after {old.log_id!r}, {old.log_idx}"
            raise CFlowError(f"frames[{i}].log_id, log_idx: {found}; give consecutive frames of one log")
    return read


def _read_frame(name: str, frame: Any, timestamp_ns: int | None) -> _LogFrame:
    points = np.asarray(getattr(frame.pc.full_pc, "points", frame.pc.full_pc))
    check_array(points, f"{name}.pc.full_pc", (None, 3), "f", "(N, 3) floats, metres")
    if points.dtype == np.float16:  # Argoverse 2 stores float16; our own reader converts it, too
        points = points.astype(np.float32)
    mask = np.asarray(frame.pc.mask)
    check_array(mask, f"{name}.pc.mask", (len(points),), "b", f"({len(points)},) bool, one per point")
    T_ego_sensor, T_global_ego = (_pose(frame.pc.pose, name, side) for side in ("sensor_to_ego", "ego_to_global"))
    return _LogFrame(points, mask, T_ego_sensor, T_global_ego, timestamp_ns, frame.log_id, frame.log_idx)


def _earlier(known: Sequence[_LogFrame], first: _LogFrame, num_history: int) -> list[_LogFrame]:
    """Return the known frames before `first`, at most `num_history`, with poses in the global frame of `first`."""
    same = [frame for frame in known if (frame.log_id, frame.log_idx) == (first.log_id, first.log_idx)]
    if not same:  # another log, or an item without overlap, whose global frame is unrelated
        return []
    shift = first.ego_to_global @ np.linalg.inv(same[0].ego_to_global)
    older = [frame for frame in known if first.log_idx - num_history <= frame.log_idx < first.log_idx]
    return [replace(frame, ego_to_global=shift @ frame.ego_to_global) for frame in older]


def _pose(poses: Any, name: str, side: str) -> np.ndarray:
    pose = getattr(poses, side)
    return rigid_transform(pose.to_array() if hasattr(pose, "to_array") else pose, f"{name}.pc.pose.{side}")
