"""CorrelationFlow as an estimator for BucketedSceneFlowEval: its frames in, its `EgoLidarFlow` out."""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from typing import Any, List, Optional, Sequence

import numpy as np

from cflow_torch.integrations.sequence import Frame, SequenceFlow, times_in_ns
from cflow_torch.types import CFlowError
from cflow_torch.windows.ego_motion import rigid_transform


class CorrelationFlowEstimator:
    """Flow for the frames that a data set of BucketedSceneFlowEval (2.0.25) yields.

    Args:
        preset: "default", "fast", "keypoints" or "paper", see `make_config`.
        device: "auto" = a GPU if there is one, else the CPU.
        ground: None = ground is what the frames' masks leave out (`with_ground=False`); "auto" or "patchwork" = find
            it in every sweep as well.
        **settings: any field of `Config`, for example `num_history=2`.

    Raises:
        CFlowError: an unknown setting or an invalid value.

    Example:
        dataset = Argoverse2CausalSceneFlow(root, with_ground=False)
        evaluator = CorrelationFlowEstimator("default").evaluate(dataset)
        evaluator.compute_results()
    """

    def __init__(self, preset: str = "default", device: Any = "auto", ground: Optional[str] = None, **settings: Any):
        self.sequence_flow = SequenceFlow(preset, device, ground, **settings)

    def __call__(self, frames: Sequence[Any]) -> List[Any]:
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
        """Flow of the frame before the last: what a causal data set scores. The frames before it are history only.

        Args:
            frames: as in `__call__`.

        Returns:
            One `EgoLidarFlow`, for `frames[-2]`.

        Raises:
            CFlowError: as `__call__`.
        """
        return self._flows(_read_frames(frames), len(frames) - 2)[0]

    def evaluate(self, dataset: Any, evaluator: Any = None) -> Any:
        """Estimate and score all that a data set scores.

        Args:
            dataset: an `AbstractDataset`. Causal: the frame before the last of each item is scored; non-causal: every
                frame but the last.
            evaluator: None = `dataset.evaluator()`.

        Returns:
            The evaluator; `compute_results()` is yours to call.

        Convention:
            Items that overlap (a causal data set, step 1) lend each other their history: with `subsequence_length=2`
            every frame of a log but its last is scored, the first ones with a shorter history.

        Raises:
            CFlowError: as `__call__`.
        """
        evaluator = dataset.evaluator() if evaluator is None else evaluator
        is_causal = dataset.loader_type().name == "CAUSAL"
        known: List[_LogFrame] = []
        for number in range(len(dataset)):
            item = dataset[number]
            frames = _read_frames(item)
            older = _earlier(known, frames[0], self.sequence_flow.num_history)
            known = [*older, *frames]
            first = len(item) - 2 if is_causal else 0
            for frame, flow in zip(item[first:], self._flows(known, len(older) + first)):
                evaluator.eval(flow, frame)
        return evaluator

    def _flows(self, frames: Sequence[_LogFrame], first: int) -> List[Any]:
        flow_class = _flow_class()
        (flows,) = self.sequence_flow([[frame.sweep for frame in frames]], [first])
        return [
            flow_class(full_flow=flow.cpu().numpy(), mask=frame.mask.copy())  # its evaluator overwrites masks
            for flow, frame in zip(flows, frames[first:])
        ]


@dataclass(frozen=True)
class _LogFrame:
    """A frame and its place.

    Args:
        log_id: name of the log.
        log_idx: number of the sweep in it.
        sweep: points, what takes part, poses.
        mask: (N,) bool, `pc.mask`.
    """

    log_id: str
    log_idx: int
    sweep: Frame
    mask: np.ndarray


def _read_frames(frames: Any) -> List[_LogFrame]:
    """Checked frames of one log; their fields matter, not their classes."""
    if not isinstance(frames, (list, tuple)) or len(frames) < 2:
        given = f"holds {len(frames)}" if isinstance(frames, (list, tuple)) else f"is {type(frames).__name__}"
        raise CFlowError(f"frames {given}: give a list of at least two frames of one log, in order of time")
    pairs = [frame if isinstance(frame, tuple) and len(frame) == 2 else (frame, None) for frame in frames]
    stamps = times_in_ns([_number(frame, f"frames[{i}]", "log_timestamp") for i, (frame, _) in enumerate(pairs)])
    result: List[_LogFrame] = []
    for i, (frame, data) in enumerate(pairs):
        name = f"frames[{i}]"
        sweep, mask = _read_sweep(_field(frame, name, "pc"), f"{name}.pc")
        if data is not None:
            is_ground = _mask(_field(data, f"{name}[1]", "is_ground_points"), f"{name}[1].is_ground_points", len(mask))
            sweep = replace(sweep, takes_part=mask & ~is_ground)
        log_id, log_idx = _field(frame, name, "log_id"), _number(frame, name, "log_idx")
        if result and log_id != result[0].log_id:
            raise CFlowError(f"{name}.log_id is {log_id!r} after {result[0].log_id!r}: give frames of one log")
        if result and log_idx != result[-1].log_idx + 1:
            raise CFlowError(
                f"{name}.log_idx is {log_idx} after {result[-1].log_idx}: give consecutive frames, in order of time"
            )
        result.append(_LogFrame(log_id, log_idx, replace(sweep, timestamp_ns=stamps[i]), mask))
    return result


def _read_sweep(pc: Any, name: str) -> Any:
    """Sweep and mask of a `PointCloudFrame`."""
    points = _field(pc, name, "full_pc")
    points = np.asarray(getattr(points, "points", points))
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        raise CFlowError(f"{name}.full_pc has shape {points.shape}, {points.dtype}: give (N, 3) floating-point metres")
    mask = _mask(_field(pc, name, "mask"), f"{name}.mask", len(points))
    pose = _field(pc, name, "pose")
    poses = {}
    for side in ("sensor_to_ego", "ego_to_global"):
        transform = _field(pose, f"{name}.pose", side)
        matrix = transform.to_array() if hasattr(transform, "to_array") else transform
        poses[side] = rigid_transform(matrix, f"{name}.pose.{side}")
    return Frame(points, mask, poses["sensor_to_ego"], poses["ego_to_global"]), mask


def _earlier(known: Sequence[_LogFrame], first: _LogFrame, num_history: int) -> List[_LogFrame]:
    """Known frames before `first`, at most `num_history`, with poses in the global frame that `first` has."""
    same = [frame for frame in known if (frame.log_id, frame.log_idx) == (first.log_id, first.log_idx)]
    if not same:  # another log, or items that do not overlap: their global frames have nothing in common
        return []
    shift = first.sweep.ego_to_global @ np.linalg.inv(same[0].sweep.ego_to_global)
    older = [frame for frame in known if frame.log_idx < first.log_idx]
    return [
        replace(frame, sweep=replace(frame.sweep, ego_to_global=shift @ frame.sweep.ego_to_global))
        for frame in older[max(len(older) - num_history, 0) :]
    ]


def _flow_class() -> Any:
    try:
        return importlib.import_module("bucketed_scene_flow_eval.datastructures").EgoLidarFlow
    except (ImportError, AttributeError) as error:
        raise CFlowError(
            f"bucketed_scene_flow_eval cannot be used ({error}): pip install 'bucketed-scene-flow-eval>=2.0.25' "
            "(it needs Python 3.10 and open3d)"
        ) from None


def _field(holder: Any, name: str, field: str) -> Any:
    if not hasattr(holder, field):
        raise CFlowError(
            f"{name} is {type(holder).__name__} without {field!r}: give frames of bucketed_scene_flow_eval "
            "(TimeSyncedSceneFlowFrame)"
        )
    return getattr(holder, field)


def _number(holder: Any, name: str, field: str) -> int:
    value = _field(holder, name, field)
    try:
        return int(value)
    except (TypeError, ValueError):
        raise CFlowError(f"{name}.{field} is {value!r}: give a whole number") from None


def _mask(mask: Any, name: str, length: int) -> np.ndarray:
    mask = np.asarray(mask)
    if mask.shape != (length,) or mask.dtype != np.bool_:
        raise CFlowError(
            f"{name} has shape {mask.shape}, {mask.dtype}: give ({length},) bool, one per point of full_pc"
        )
    return mask
