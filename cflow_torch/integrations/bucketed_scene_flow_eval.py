"""CorrelationFlow as an estimator for BucketedSceneFlowEval: its frames in, its `EgoLidarFlow` out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, Sequence

import numpy as np

from cflow_torch.integrations.sequence import Frame, SequenceFlow, import_from, times_in_ns
from cflow_torch.types import CFlowError
from cflow_torch.windows.ego_motion import rigid_transform


class CorrelationFlowEstimator:
    """Flow for the frames that a data set of BucketedSceneFlowEval (2.0.25) yields.

    Args:
        preset, device, ground, **settings: as for `SequenceFlow`, for example `num_history=2`.

    Raises:
        CFlowError: an unknown setting or an invalid value.
    """

    def __init__(self, preset: str | None = None, device: Any = "auto", ground: str | None = None, **settings: Any):
        self.sequence_flow = SequenceFlow(preset, device, ground, **settings)

    def __call__(self, frames: Sequence[Any]) -> list[Any]:
        """Flow of every frame but the last.

        Args:
            frames: K >= 2 `TimeSyncedSceneFlowFrame` (or raw frames) of one log, consecutive, in order of time: an item
                of a data set; or pairs (frame, `TimeSyncedAVLidarData`), as a sequence's `load_frame_list` gives them.

        Returns:
            K - 1 `EgoLidarFlow`: flow i is for all points of `frames[i].pc.full_pc`, in their order.

        Convention:
            full_flow: (N, 3) float32, metres until frame i + 1, residual (ego motion taken out), axes of frame i's
                points. 0 for points that take no part (ground, outside `point_cloud_range`).
            mask: the frame's own `pc.mask`. A 0 outside the method's range is a prediction like any other.
            Frames before i are its history, as many as there are, at most `num_history`.
            A point takes part if `pc.mask` is True (not ground, in the data set's range); of a pair (frame, data), if
                also `is_ground_points` is False. `in_range_mask` of a pair is not used.

        Raises:
            CFlowError: by the name of the field, for example "frames[1].pc.mask"; the package is not installed.
        """
        return self._flows(_read_frames(frames), 0)

    def last(self, frames: Sequence[Any]) -> Any:
        """The `EgoLidarFlow` of `frames[-2]`: what a causal data set scores. Frames and errors as for `__call__`."""
        return self._flows(_read_frames(frames), len(frames) - 2)[0]

    def evaluate(self, dataset: Any) -> Any:
        """Estimate and score all that a data set scores.

        Args:
            dataset: an `AbstractDataset`. Causal: the frame before the last of each item is scored; non-causal: every
                frame but the last.

        Returns:
            `dataset.evaluator()`, fed; `compute_results()` is yours to call. Errors as for `__call__`.

        Convention:
            Items that overlap (a causal data set, step 1) lend each other their history: with `subsequence_length=2`
            every frame of a log but its last is scored, the first ones with a shorter history.
        """
        evaluator = dataset.evaluator()
        is_causal = dataset.loader_type().name == "CAUSAL"
        known: list[_LogFrame] = []
        for number in range(len(dataset)):
            item = dataset[number]
            frames = _read_frames(item)
            older = _earlier(known, frames[0], self.sequence_flow.num_history)
            known = [*older, *frames]
            first = len(item) - 2 if is_causal else 0
            for frame, flow in zip(item[first:], self._flows(known, len(older) + first)):
                evaluator.eval(flow, frame)
        return evaluator

    def _flows(self, frames: Sequence[_LogFrame], first: int) -> list[Any]:
        how = "pip install 'bucketed-scene-flow-eval>=2.0.25' (it needs Python 3.10 and open3d)"
        flow_class = import_from("bucketed_scene_flow_eval.datastructures", "EgoLidarFlow", how)
        (flows,) = self.sequence_flow([[frame.sweep for frame in frames]], [first])
        return [
            flow_class(full_flow=flow.cpu().numpy(), mask=frame.mask.copy())  # its evaluator overwrites masks
            for flow, frame in zip(flows, frames[first:])
        ]


class _LogFrame(NamedTuple):
    """A frame, its place (log, number of the sweep in it) and (N,) bool `pc.mask`."""

    log_id: str
    log_idx: int
    sweep: Frame
    mask: np.ndarray


def _read_frames(frames: Any) -> list[_LogFrame]:
    """Checked frames of one log; their fields matter, not their classes."""
    if not isinstance(frames, (list, tuple)) or len(frames) < 2:
        raise CFlowError("frames: give a list of at least two frames of one log, in order of time")
    pairs = [frame if isinstance(frame, tuple) and len(frame) == 2 else (frame, None) for frame in frames]
    read = [_read_frame(f"frames[{i}]", *pair) for i, pair in enumerate(pairs)]
    for i, (old, new) in enumerate(zip(read, read[1:]), 1):
        if (new.log_id, new.log_idx) != (old.log_id, old.log_idx + 1):
            places = f"{new.log_id!r}, {new.log_idx} after {old.log_id!r}, {old.log_idx}"
            raise CFlowError(f"frames[{i}].log_id, log_idx: {places}; give consecutive frames of one log")
    stamps = times_in_ns([frame.log_timestamp for frame, _ in pairs])
    return [frame._replace(sweep=replace(frame.sweep, timestamp_ns=t)) for frame, t in zip(read, stamps)]


def _read_frame(name: str, frame: Any, data: Any) -> _LogFrame:
    """A frame without its time; `data` is its `TimeSyncedAVLidarData`, or None."""
    points = np.asarray(getattr(frame.pc.full_pc, "points", frame.pc.full_pc))
    if points.ndim != 2 or points.shape[1] != 3:
        raise CFlowError(f"{name}.pc.full_pc has shape {points.shape}: give (N, 3) metres")
    if points.dtype == np.float16:  # the files of Argoverse 2, which our own reader converts as well
        points = points.astype(np.float32)
    is_active = mask = _mask(frame.pc.mask, f"{name}.pc.mask", len(points))
    if data is not None:
        is_active = mask & ~_mask(data.is_ground_points, f"{name}[1].is_ground_points", len(points))
    T_ego_sensor, T_global_ego = (_pose(frame.pc.pose, name, side) for side in ("sensor_to_ego", "ego_to_global"))
    return _LogFrame(frame.log_id, frame.log_idx, Frame(points, is_active, T_ego_sensor, T_global_ego), mask)


def _earlier(known: Sequence[_LogFrame], first: _LogFrame, num_history: int) -> list[_LogFrame]:
    """Known frames before `first`, at most `num_history`, with poses in the global frame that `first` has."""
    same = [frame for frame in known if (frame.log_id, frame.log_idx) == (first.log_id, first.log_idx)]
    if not same:  # another log, or items that do not overlap: their global frames have nothing in common
        return []
    shift = first.sweep.ego_to_global @ np.linalg.inv(same[0].sweep.ego_to_global)
    older = [frame for frame in known if frame.log_idx < first.log_idx]
    return [
        frame._replace(sweep=replace(frame.sweep, ego_to_global=shift @ frame.sweep.ego_to_global))
        for frame in older[max(len(older) - num_history, 0) :]
    ]


def _mask(values: Any, name: str, length: int) -> np.ndarray:
    mask = np.asarray(values)
    if mask.shape != (length,) or mask.dtype != np.bool_:
        raise CFlowError(f"{name} has shape {mask.shape}, {mask.dtype}: give ({length},) bool, one per point")
    return mask


def _pose(poses: Any, name: str, side: str) -> np.ndarray:
    pose = getattr(poses, side)
    return rigid_transform(pose.to_array() if hasattr(pose, "to_array") else pose, f"{name}.pc.pose.{side}")
