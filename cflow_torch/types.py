"""What goes in and what comes out: `Sweep`, `Window`, `FlowResult`, and the one error class."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Dict, Optional, Tuple, Union

import numpy as np
import torch
from torch import Tensor

Array = Union[np.ndarray, Tensor]


def as_numpy(value: Array, dtype: Optional[Any] = None) -> np.ndarray:
    """NumPy array of an array or of a tensor on any device; bfloat16, which NumPy lacks, becomes float32."""
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value.float() if value.dtype == torch.bfloat16 else value).numpy()
    return np.asarray(value, dtype=dtype)


class CFlowError(ValueError):
    """The only error this package raises for bad input, bad files and bad settings.

    The message says what was given, what is allowed, and how to put it right.
    """


@dataclass(frozen=True)
class Sweep:
    """One LiDAR sweep.

    Args:
        points: (N, 3+) float, metres, in the ego frame of this sweep; columns after z are ignored.
        is_ground: (N,) bool, True = ground; None = no point is ground.
        pose: (4, 4) float64 `T_world_ego`, ego coordinates to world; None = the points already lie in
            the frame of t+1 (then no sweep of the window may have a pose).
        timestamp_ns: time of the sweep in nanoseconds, None = unknown.
    """

    points: Array
    is_ground: Optional[Array] = None
    pose: Optional[Array] = None
    timestamp_ns: Optional[int] = None


@dataclass(frozen=True)
class Window:
    """The sweeps that one flow is estimated from: t-h ... t+1 and, offline, some after t+1.

    Args:
        pc0: sweep t; the flow is given for its points.
        pc1: sweep t+1; its ego frame is the frame of the flow.
        pch: sweeps t-1, t-2, ... t-h, nearest first; may be shorter than `num_history`.
        pcf: sweeps t+2, t+3, ..., nearest first; may be shorter than `num_future`.
    """

    pc0: Sweep
    pc1: Sweep
    pch: Tuple[Sweep, ...] = ()
    pcf: Tuple[Sweep, ...] = ()


@dataclass(frozen=True)
class FlowResult:
    """Flow t -> t+1 of every point of pc0, rows in pc0's order (ground and out-of-range rows included).

    Args:
        residual_flow: (N, 3) float32, metres per sweep interval, axes of ego1: motion of objects.
        pose_flow: (N, 3) float32, T_ego1_ego0 p - p: motion that the moving sensor causes.
        flow: (N, 3) float32, the sum of the two (total flow).
        cluster_id: (N,) int64, 0 ... M-1 in raster order of each cluster's first pixel; -1 = in no cluster
            that has points both before and at t+1.
        score: (N,) float32 in [0, 1], NCC at the peak (t -> t+1, finest scale); 0 where cluster_id is -1.
        is_valid: (N,) bool, True for the rows that took part: finite, neither ground nor of the
            vehicle itself (`Config.ego_box`), inside the range.
        confidence: (N,) float32 in [0, 1] by the verified method, else None: estimated probability that the end-point
            error of the residual flow (of a point that moves or stands still) is below 0.1 m per sweep interval; 0
            where is_valid is False. From a table fitted on simulated drives, see docs/verified.md.
    """

    residual_flow: Tensor
    pose_flow: Tensor
    flow: Tensor
    cluster_id: Tensor
    score: Tensor
    is_valid: Tensor
    confidence: Optional[Tensor] = None

    def to(self, device: Any) -> FlowResult:
        """The same result on another device."""
        return FlowResult(**{name: value.to(device) for name, value in self._given().items()})

    def numpy(self) -> dict:
        """Every field that is not None as a NumPy array, by name."""
        return {name: value.detach().cpu().numpy() for name, value in self._given().items()}

    def _given(self) -> Dict[str, Tensor]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {name: value for name, value in values.items() if value is not None}
