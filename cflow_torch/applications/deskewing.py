"""De-skewing: points that were measured one after the other, taken to one instant by the flow of what they lie on."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.ego_motion import compensate, relative_transform
from cflow_torch.windows.validation import read_positions


def deskew(window: Window, result: FlowResult, sweep_interval: float = 0.1) -> Tensor:
    """Where the points of sweep t were at the instant of that sweep.

    A turning LiDAR meets a car twice, or its front later than its rear; what moves is then torn or stretched. Here each
    point goes back by the part of its flow that passed between the instant of the sweep and its own measurement. The
    motion of the vehicle itself must have been compensated, as readers do.

    Args:
        window: the sweeps of the flow; `pc0.point_times` and the poses and time stamps of pc0 and pc1 are used.
        result: flow of its points, from a preset that uses times (`default`, `offline`).
        sweep_interval: seconds from t to t+1 where the two have no time stamps.

    Returns:
        (N, 3) float64, metres, ego frame of sweep t, on the device of the result. What stands, or has no flow, stays.

    Convention: the motion passes in proportion to time, along a straight line.

    Raises:
        CFlowError: no times of points; a result with another number of points, or from a file without residual flow.

    Example:
        >>> result = VerifiedFlow.from_preset("default")([window])[0]
        >>> points = deskew(window, result)
    """
    before, after = window.pc0, window.pc1
    if before.point_times is None:
        raise CFlowError("the sweep has no times of points: give Sweep(points, point_times=...), or take it as it is")
    if result.residual_flow is None or len(result.residual_flow) != len(before.points):
        raise CFlowError(f"give the residual flow of each of the {len(before.points)} points of pc0")
    interval = sweep_interval
    if before.timestamp_ns is not None and after.timestamp_ns is not None:
        interval = (after.timestamp_ns - before.timestamp_ns) / 1e9
    if not interval > 0:
        raise CFlowError(f"t+1 is {interval} s after t: give time stamps in order, or a positive sweep_interval")
    flow = result.residual_flow.double().t()
    if before.pose is not None:  # from the axes of t+1 into those of t
        turn = np.eye(4)
        turn[:3, :3] = relative_transform(before.pose, after.pose)[:3, :3]
        flow = compensate(flow, turn)
    times = torch.as_tensor(before.point_times).to(flow.device, torch.float64)
    return (read_positions(before, flow.device) - flow * (times / interval)).t()
