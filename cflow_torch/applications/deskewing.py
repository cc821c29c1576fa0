"""De-skewing of moving objects: move each point to the time of its sweep by the flow of its object."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.ego_motion import compensate, relative_transform
from cflow_torch.windows.validation import read_positions


def deskew(window: Window, result: FlowResult, sweep_interval: float = 0.1) -> Tensor:
    """Move the points of sweep t to where they were at the time stamp of that sweep.

    A spinning LiDAR may meet a car twice, or its front later than its rear; the car is then torn or stretched. We move
    each point back by the part of its flow between the time stamp and its own measurement, as if objects moved at
    constant velocity within the sweep. The motion of the recording vehicle must have been compensated already, as our
    readers do.

    Args:
        window: the sweeps of the flow; `pc0.point_times` and the poses and time stamps of pc0 and pc1 are used.
        result: flow of its points, from a preset that uses point times (`default`, `offline`).
        sweep_interval: seconds from t to t+1 where the two have no time stamps.

    Returns:
        (N, 3) float64, metres, ego frame of sweep t, on the device of the result. Points that are static or have no
        flow keep their positions.

    Raises:
        CFlowError: the sweep has no point times, the times are not in order, or the result has another number of points
            or lacks the residual flow.

    Examples:
        >>> result = VerifiedFlow.from_preset("default")([window])[0]
        >>> points = deskew(window, result)
    """
    before, after = window.pc0, window.pc1
    if before.point_times is None:
        raise CFlowError("the sweep has no times of points: give Sweep(points, point_times=...)")
    if result.residual_flow is None or len(result.residual_flow) != len(before.points):
        raise CFlowError(f"give the residual flow of each of the {len(before.points)} points of pc0")
    interval = sweep_interval
    if before.timestamp_ns is not None and after.timestamp_ns is not None:
        interval = (after.timestamp_ns - before.timestamp_ns) / 1e9
    if not interval > 0:
        raise CFlowError(f"t+1 is {interval} s after t: give time stamps in order, or a positive sweep_interval")
    flow = result.residual_flow.double().t()
    if before.pose is not None:  # from the axes of t+1 into those of t
        rotation = relative_transform(before.pose, after.pose)
        rotation[:3, 3] = 0
        flow = compensate(flow, rotation)
    times = torch.as_tensor(before.point_times).to(flow.device, torch.float64)
    return (read_positions([before], flow.device) - flow * (times / interval)).t()
