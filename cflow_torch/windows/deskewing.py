"""De-skewing: move each point to the instant of its sweep, by the motion of the vehicle, or of the object it is on."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from cflow_torch.ops.indices import divide
from cflow_torch.tensors import float64_tensor, read_positions
from cflow_torch.transforms import relative_transform, rigid_transform
from cflow_torch.types import Array, CFlowError, FlowResult, Window, as_numpy, check_array, point_rows
from cflow_torch.windows.ego_motion import compensate
from cflow_torch.windows.timeline import SourceSweep, elapsed_times

DIRECTIONS = {"clockwise": -1.0, "counterclockwise": 1.0}  # seen from above -> sign of the growing azimuth
STARTS = {"": 0.5, "_left": 0.25, "_ahead": 0.0, "_right": -0.25}  # ending of the name -> azimuth of the start, turns
INSTANTS = {"": None, "_at_start": 0.0, "_at_end": -1.0}  # ending of the name -> turns from the instant to the start
SCANS = {
    f"{name}{start}{instant}": (name, start, instant) for instant in INSTANTS for start in STARTS for name in DIRECTIONS
}
"""Names of scans: clockwise and counterclockwise begin behind the vehicle, clockwise_left at its left, and so on."""
ENDINGS = "with _left, _ahead or _right behind it, then _at_start or _at_end"
_SMALLEST_SINE = 1e-12  # of the angle; a smaller rotation has no axis, and moves no point by a nanometre


def scan_fractions(points: Array, direction: str, origin: Any = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return when a rotating LiDAR measured each point, from its azimuth, in turns: (N,) float64.

    Args:
        points: (N, 3+) float, metres, as measured, x forward and y left.
        direction: "clockwise" or "counterclockwise", seen from above, for a turn that begins behind the vehicle. With
            the ending "_left", "_ahead" or "_right" the turn begins there. KITTI's LiDAR turns clockwise from behind.
            The last ending, "_at_start" or "_at_end", tells the instant of the sweep.
        origin: (3,) float, metres, position of the LiDAR in the frame of the points.

    Convention: 0 = the instant of the sweep, negative = earlier. The instant is when the LiDAR looks ahead, unless the
        name says that it is the start or the end of the turn. The result is in [-0.5, 0.5] for a turn that begins
        behind, as KITTI's, [-0.25, 0.75) for "clockwise_left", and [0, 1) for one that begins ahead. It is in [0, 1)
        for every "_at_start", and in [-1, 0) for every "_at_end". If you name a wrong start, some points are one turn
        off in every sweep: static objects still stay in place, unless they pass the start.
    """
    if direction not in SCANS:
        raise CFlowError(f"direction={direction!r}: choose one of {', '.join(DIRECTIONS)}, or one {ENDINGS}")
    name, start, instant = SCANS[direction]
    x, y, _ = (point_rows("points", points) - np.asarray(origin, np.float64)).T
    turns = DIRECTIONS[name] * np.arctan2(y, x) / (2 * np.pi)
    if not start and not instant:
        return turns
    first = -((-DIRECTIONS[name] * STARTS[start]) % 1)  # between -1 and 0
    to_start = INSTANTS[instant]
    return (first if to_start is None else to_start) + (turns - first) % 1


def deskew_points(points: Array, fraction: Array, T_ego1_ego0: Any, T_ego0_before: Any = None) -> np.ndarray:
    """Move the points of sweep t to the instant of the sweep, by the motion of the vehicle since their measurement.

    A rotating LiDAR measures for a whole sweep interval. If the data set does not compensate this, each point is in the
    frame of the vehicle at its own instant. Static objects beside the road then seem to move: what was measured ahead
    in one sweep is measured half a turn later in the next one. Points of moving objects still have their own motion
    afterwards. Pass their times as `Sweep.point_times`, so that the presets `default`, `offline` and `live` correct it.

    Args:
        points: (N, 3+) float, metres, ego frame of t at the instant of each measurement.
        fraction: (N,) float, time from the instant of the sweep to each measurement, in sweep intervals, negative =
            before it. It is `seconds / sweep_interval`, or `scan_fractions(points, "clockwise")`.
        T_ego1_ego0: (4, 4), maps the ego frame of t to that of t+1.
        T_ego0_before: (4, 4), maps the ego frame of t-1 to that of t; None = the same motion as from t to t+1.

    Returns:
        (N, 3) array, float32 for float32 or smaller points, else float64, in the ego frame at the instant of the sweep.
        Points that are not finite stay so.

    Convention: the velocity and the rotation rate of the vehicle are constant between two sweeps. We compute in
        float64, and round at the end.

    Raises:
        CFlowError: wrong shape, or a transform that is not rigid.

    Examples:
        >>> fraction = scan_fractions(pc0, "clockwise")
        >>> moved = deskew_points(pc0, fraction, T_ego1_ego0)
        >>> sweep = Sweep(moved, pose=T_ego1_ego0, point_times=0.1 * fraction)
        >>> result = estimate_flow(sweep, Sweep(moved1, pose=np.eye(4), point_times=0.1 * fraction1))
    """
    positions = point_rows("points", points)
    check_array(fraction, "fraction", (len(positions),), "f", f"({len(positions)},) floats, in sweep intervals")
    share = as_numpy(fraction).astype(np.float64)
    forward = rigid_transform(T_ego1_ego0, "T_ego1_ego0")
    before = forward if T_ego0_before is None else rigid_transform(T_ego0_before, "T_ego0_before")
    is_later = share > 0
    moved = np.empty_like(positions)
    for rows, T_ego0_other in ((is_later, np.linalg.inv(forward)), (~is_later, before)):
        moved[rows] = _move_part(positions[rows], np.abs(share[rows]), T_ego0_other)
    is_wide = as_numpy(points).dtype.itemsize > 4
    return moved if is_wide else moved.astype(np.float32)


def _move_part(points: np.ndarray, share: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Move each point by its share of a rigid motion (4, 4) of constant velocity and rotation rate.

    Source: the formula of Rodrigues, with another angle for each point.
    """
    moved = points + share[:, None] * T[:3, 3]
    cross = (T[:3, :3] - T[:3, :3].T) / 2  # sin(angle) times the matrix of the cross product with the axis
    sine = float(np.linalg.norm(cross)) / np.sqrt(2)
    if sine < _SMALLEST_SINE:
        return moved
    cross /= sine
    angle = share * np.arctan2(sine, (np.trace(T[:3, :3]) - 1) / 2)
    moved += np.sin(angle)[:, None] * (points @ cross.T)
    moved += (1 - np.cos(angle))[:, None] * (points @ (cross @ cross).T)
    return moved  # type: ignore[no-any-return]


def deskew_objects(window: Window, result: FlowResult, sweep_interval: float = 0.1) -> Tensor:
    """Move the points of sweep t to where they were at the time stamp of that sweep.

    A spinning LiDAR may scan a car twice, or the front of a car later than its rear. The car then looks torn or
    stretched. We assume that objects move at constant velocity within the sweep, and undo the motion of each point
    since the time stamp. The points must already be compensated for the motion of the recording vehicle. Our readers do
    this.

    Args:
        window: the sweeps of the flow; `pc0.point_times` and the poses of pc0 and pc1 are used, and the time
            stamps if all sweeps have one.
        result: flow of the points of pc0, by a preset that uses point times (`default`, `offline`, `live`).
        sweep_interval: seconds from t to t+1 if a sweep of the window has no time stamp, as in the settings.

    Returns:
        (N, 3) float64, metres, ego frame of sweep t, on the device of the result. Points that are static or have no
        flow keep their positions.

    Raises:
        CFlowError: the sweep has no point times, t+1 is not after t, `sweep_interval` is not positive, or the result
            has another number of points or lacks the residual flow.

    Examples:
        >>> result = VerifiedFlow.from_preset("default")([window])[0]
        >>> points = deskew_objects(window, result)
    """
    before = window.pc0
    if before.point_times is None:
        raise CFlowError("the sweep has no times of points: give Sweep(points, point_times=...)")
    if result.residual_flow is None or len(result.residual_flow) != len(before.points):
        raise CFlowError(f"give the residual flow of each of the {len(before.points)} points of pc0")
    ((_, interval),) = elapsed_times(window, [SourceSweep("pc0", before, 1)], sweep_interval)
    if not interval > 0:
        raise CFlowError(f"sweep_interval={sweep_interval} is not a positive number of seconds")
    flow = result.residual_flow.double().t()
    if before.pose is not None:  # from the axes of t+1 to the axes of t
        rotation = relative_transform(before.pose, window.pc1.pose)
        rotation[:3, 3] = 0
        flow = compensate(flow, rotation)
    times = float64_tensor(before.point_times, flow.device)
    return (read_positions([before], flow.device) - flow * divide(times, interval)).t()
