"""De-skewing of moving objects: move each point to the time of its sweep by the flow of its object."""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.types import CFlowError, FlowResult, Window
from cflow_torch.windows.ego_motion import compensate, relative_transform
from cflow_torch.windows.validation import read_positions


def deskew(window: Window, result: FlowResult, sweep_interval: float = 0.1) -> Tensor:
    """Move the points of sweep t to where they were at the time stamp of that sweep.

    A spinning LiDAR may scan a car twice, or the front of a car later than its rear. The car then looks torn or
    stretched. We assume that objects move at constant velocity within the sweep, and undo the motion of each point
    since the time stamp. The points must already be compensated for the motion of the recording vehicle. Our readers do
    this.

    Args:
        window: the sweeps of the flow; `pc0.point_times` and the poses and time stamps of pc0 and pc1 are used.
        result: flow of the points of pc0, by a preset that uses point times (`default`, `offline`, `live`).
        sweep_interval: seconds from t to t+1 where the two have no time stamps.

    Returns:
        (N, 3) float64, metres, ego frame of sweep t, on the device of the result. Points that are static or have no
        flow keep their positions.

    Raises:
        CFlowError: the sweep has no point times, t+1 is not after t, or the result has another number of points or
            lacks the residual flow.

    Examples:
        >>> result = VerifiedFlow.from_preset("default")([window])[0]
        >>> points = deskew(window, result)
    """
    before = window.pc0
    after = window.pc1
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
    if before.pose is not None:  # from the axes of t+1 to the axes of t
        rotation = relative_transform(before.pose, after.pose)
        rotation[:3, 3] = 0
        flow = compensate(flow, rotation)
    times = torch.as_tensor(before.point_times).to(flow.device, torch.float64)
    return (read_positions([before], flow.device) - flow * (times / interval)).t()
