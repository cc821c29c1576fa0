"""Estimate flow with one call: two point clouds in, flow out."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Sequence

import numpy as np

from cflow_torch.config import Config, make_config
from cflow_torch.dense.method import CorrelationFlow
from cflow_torch.diagnosis.inspection import Inspection, MotionWatch
from cflow_torch.errors import warn
from cflow_torch.ground.segmentation import GROUND_METHODS, find_ground_batch
from cflow_torch.keypoints.method import CorrelationFlowKeypoints
from cflow_torch.model import SceneFlowModel
from cflow_torch.tensors import choose_device
from cflow_torch.transforms import rigid_transform
from cflow_torch.types import Array, CFlowError, FlowResult, Sweep, Window, check_sweep
from cflow_torch.verified.method import VerifiedFlow
from cflow_torch.windows.returns import MISSING, without_missing
from cflow_torch.windows.validation import keep_nearest

# Arguments that a `Sweep` contains.
_IN_SWEEPS = {"dt0", "dt1", "pch", "gmh", "dth", "T_ego1_egoh", "pcf", "gmf", "dtf", "T_ego1_egof"}


def estimate_flow(
    pc0: Array | Sweep,  # (N0, 3+), metres, ego frame of sweep t
    pc1: Array | Sweep,  # (N1, 3+), metres, ego frame of sweep t+1
    T_ego1_ego0: Array | None = None,  # (4, 4)
    *,
    gm0: Array | None = None,  # (N0,) bool
    gm1: Array | None = None,  # (N1,) bool
    history: Sequence[Sweep] = (),
    future: Sequence[Sweep] = (),
    ground: str | None = "auto",
    preset: str | Config = "default",
    device: Any = "auto",
    **settings: Any,
) -> FlowResult:
    """Estimate the scene flow from sweep t to sweep t+1.

    Args:
        pc0: points of sweep t, (N0, 3+) float of any width, array or tensor. Columns after z are ignored. Or a `Sweep`,
            which also contains mask, pose and times of points; then `pc1` is a `Sweep`, too.
        pc1: points of sweep t+1, (N1, 3+).
        T_ego1_ego0: (4, 4), maps the ego frame at t to the ego frame at t+1 (pose1^-1 pose0). None = pc0 is already in
            the frame of t+1. Sweeps have poses instead.
        gm0, gm1: ground masks, (N,) bool, True = ground; None = see `ground`. Sweeps have `is_ground` instead.
        history: sweeps t-1, t-2, ..., nearest first; we use the nearest `num_history` of them. `pc0` and `pc1` are
            sweeps, too.
        future: sweeps t+2, t+3, ..., nearest first, at most `num_future`; for the preset "offline".
        ground: what to do with sweeps without a mask. "grid" = find their ground (`find_ground`); "auto" = the same,
            with a warning; "patchwork" = use Patchwork++ (`pip install pypatchworkpp`); None = no point is ground.
        preset: "default", "offline", "live", "keypoints", "paper" or "paper_keypoints"; or the result of `make_config`.
        device: "auto" = the device of the tensors, else a GPU if there is one, else the CPU.
        **settings: any field of the settings, for example `pixel_sizes=(0.4, 0.2, 0.1)`.

    Returns:
        Flow for every row of pc0, in the axes of the ego frame at t+1, on the device of the computation.

    Convention:
        NaN and infinite points, missing returns (see `missing_returns` of cflow_torch.windows.returns), ground and
        points outside `point_cloud_range` get residual flow 0, cluster -1 and `is_valid` False. Empty sweeps give an
        empty or all-zero result. We do not search points on a GPU, nor more than ten million, for missing returns.

    Warns:
        CFlowWarning: we left out missing returns; a sweep has no mask, so we found its ground (`ground="auto"`); a
            likely mistake in the input, see `Inspection`; `is_valid` is False for all points of pc0.

    Raises:
        CFlowError: wrong shape or dtype, a transform that is not rigid, mixed devices, an unknown setting.

    Examples:
        >>> car = 0.1 * np.stack(np.meshgrid(range(45), range(18), range(15)), -1).reshape(-1, 3) + 5.05  # (12150, 3)
        >>> result = estimate_flow(car, car + [0.5, 0.0, 0.0])
        >>> result.residual_flow[0]  # metres until the next sweep
        tensor([0.5000, 0.0000, 0.0000])

    Source: Alg. general_correlation_flow; Sec. CorrelationFlow-Keypoints.
    """
    if ground not in GROUND_METHODS:
        raise CFlowError(f"ground={ground!r}: give one of {', '.join(map(repr, GROUND_METHODS))}")
    moved = sorted(_IN_SWEEPS & settings.keys())
    if moved:
        raise CFlowError(
            f"estimate_flow has no {', '.join(moved)}: give estimate_flow(Sweep(pc0, gm0, pose0, point_times=dt0), "
            "Sweep(pc1, ...), history=[Sweep(...), ...], future=[...])"
        )
    for name, sweeps in (("history", history), ("future", future)):
        if not isinstance(sweeps, (list, tuple)) or not all(isinstance(sweep, Sweep) for sweep in sweeps):
            raise CFlowError(f"{name}: give a list of cflow_torch.Sweep, nearest first")
    config = make_config(preset, **settings)
    if isinstance(pc0, Sweep) or isinstance(pc1, Sweep):
        if any(value is not None for value in (T_ego1_ego0, gm0, gm1)):
            raise CFlowError("T_ego1_ego0, gm0 or gm1 is given with a Sweep: put poses and masks into the sweeps")
    else:
        if len(history) > 0 or len(future) > 0:
            raise CFlowError("history and future need sweeps: give pc0 and pc1 as cflow_torch.Sweep, too")
        pc0, pc1 = _sweeps_of_arrays(pc0, pc1, T_ego1_ego0, gm0, gm1)
    window = Window(pc0, pc1, tuple(history), tuple(future))  # type: ignore[arg-type]  # it refuses arrays
    window = _leave_out_missing(keep_nearest(window, config.num_history))
    window = _find_ground(window, ground, device)
    (result,) = make_model(config, device)([window])
    Inspection()([window])
    problem = MotionWatch()(window, result) if result.is_valid.device.type == "cpu" else ""
    if problem:
        warn(problem)
    return result


def make_model(preset: str | Config = "default", device: Any = "auto", **settings: Any) -> SceneFlowModel:
    """Make the method of a preset: `CorrelationFlow`, `CorrelationFlowKeypoints` or `VerifiedFlow`.

    `preset` and `settings` are as for `make_config`, `device` is as for `estimate_flow`.
    """
    methods = {method.method: method for method in (CorrelationFlow, CorrelationFlowKeypoints, VerifiedFlow)}
    config = preset if isinstance(preset, Config) and not settings else make_config(preset, **settings)
    return methods[config.method](config, device)


def _leave_out_missing(window: Window) -> Window:
    """Leave out points that are no returns, and say so."""
    kept = [without_missing(sweep) for sweep in window.sweeps]
    num_missing = max(count for _, count in kept)
    if num_missing == 0:
        return window
    warn(f"up to {num_missing} {MISSING}, so we leave them out")
    return window.with_sweeps(sweep for sweep, _ in kept)


def _find_ground(window: Window, ground: str | None, device: Any) -> Window:
    """Add the missing ground masks."""
    sweeps = list(window.sweeps)
    bare = [index for index, sweep in enumerate(sweeps) if sweep.is_ground is None]
    clouds = [sweeps[index].points for index in bare]
    if ground is None:
        masks: list[Any] = [np.zeros(len(cloud), dtype=bool) for cloud in clouds]
    else:
        masks = find_ground_batch(clouds, ground, device=choose_device([window], device))
    if ground == "auto" and any(bool(mask.any()) for mask in masks):
        warn(
            "there is no ground mask for some sweeps, so we found their ground. To turn this line off give masks (gm0, "
            "gm1), ground='grid' (the same result), or ground=None if the clouds have no ground"
        )
    for index, mask in zip(bare, masks):
        sweeps[index] = replace(sweeps[index], is_ground=mask)
    return window.with_sweeps(sweeps)


def _sweeps_of_arrays(
    pc0: Array, pc1: Array, T_ego1_ego0: Array | None, gm0: Array | None, gm1: Array | None
) -> tuple[Sweep, Sweep]:
    """Make sweeps in a world that is the ego frame at t+1. Without a transform they have no poses."""
    check_sweep(("pc0", "gm0", "T_ego1_ego0", "dt0"), pc0, gm0, T_ego1_ego0, None)
    check_sweep(("pc1", "gm1", "T_ego1_ego0", "dt1"), pc1, gm1, None, None)
    if T_ego1_ego0 is not None:
        rigid_transform(T_ego1_ego0, "T_ego1_ego0")
    return Sweep(pc0, gm0, T_ego1_ego0), Sweep(pc1, gm1, None if T_ego1_ego0 is None else np.eye(4))
