"""Estimate the flow of sweeps as they arrive: `FlowStream`."""

from __future__ import annotations

import logging
import operator
from collections import deque
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch

from cflow_torch.config import Config, make_config
from cflow_torch.data.odometry import Odometry
from cflow_torch.diagnosis.inspection import Inspection, MotionWatch
from cflow_torch.errors import warn
from cflow_torch.estimate import make_model
from cflow_torch.ground.segmentation import GROUND_METHODS, find_ground
from cflow_torch.tensors import choose_device, float64_tensor, read_ground, read_positions
from cflow_torch.types import Array, CFlowError, FlowResult, Sweep, Window, as_numpy
from cflow_torch.windows.collation import make_batch
from cflow_torch.windows.returns import MISSING, without_missing
from cflow_torch.windows.validation import check_windows

_log = logging.getLogger(__name__)


class FlowStream:
    """Push sweeps one after the other; get the flow of a sweep as soon as the next one arrives.

    A stream keeps the last `num_history` + 2 sweeps on the device of the method, and the newest points if it
    estimates poses. A result is equal, bit for bit, to that of `make_model(config)([window])` with these sweeps.

    Args:
        preset: "live", "default", "keypoints" or "paper", or the result of `make_config`; `offline` needs later sweeps
            and is refused.
        device: "auto" = that of the given tensors, else a GPU if available, else the CPU.
        ground: what to do with a sweep without a mask. "auto" = find its ground, with a warning; "grid" = the same,
            without one; "patchwork" = use Patchwork++ (`pip install pypatchworkpp`); None = no point is ground.
        max_gap: seconds; sweeps that are further apart are not compared, and the stream starts again.
        **settings: any field of the settings.

    Attributes:
        config: the settings of the method.
        window: the sweeps of the last result, None before the first one. Rows of the result belong to `window.pc0`.

    Convention:
        We skip a sweep with a warning if it repeats the newest time stamp, or is up to `max_gap` older (a late packet).
        If it is more than `max_gap` older (the clock was set back) or newer (sweeps were lost), the stream starts
        again. Without time stamps, sweeps are `sweep_interval` apart.

    Raises:
        CFlowError: a setting is unknown, or asks for sweeps after t+1.

    Examples:
        >>> stream = FlowStream("default", sweep_interval=0.1)
        >>> for points, pose, time in sensor:
        ...     result = stream.push(points, pose, time)
        ...     if result is not None:
        ...         use(stream.window.pc0.points, result.residual_flow)
    """

    def __init__(
        self,
        preset: str | Config = "default",
        *,
        device: Any = "auto",
        ground: str | None = "auto",
        max_gap: float = 0.5,
        **settings: Any,
    ) -> None:
        if ground not in GROUND_METHODS:
            raise CFlowError(f"ground={ground!r}: give one of {', '.join(map(repr, GROUND_METHODS))}")
        if not (isinstance(max_gap, (int, float)) and max_gap > 0):
            raise CFlowError(f"max_gap={max_gap!r}: give seconds above 0")
        config = make_config(preset, **settings)
        if config.num_future > 0:
            raise CFlowError(f"num_future={config.num_future}: a stream does not know later sweeps; give num_future=0")
        self.config = config
        self._model = make_model(config, device)
        self._inspect = Inspection()
        self._watch = MotionWatch()
        self._ground = ground
        self._max_gap = max_gap
        self._sweeps: deque[Sweep] = deque(maxlen=config.num_history + 1)
        self._odometry: Odometry | None = None
        self._has_told_missing = False
        self._has_told_ground = False
        self.window: Window | None = None

    def reset(self) -> None:
        """Start again: forget all sweeps and the poses of the odometry."""
        self._sweeps.clear()
        self._odometry = self.window = None

    def push(
        self,
        points: Array | Sweep,
        pose: Array | None = None,
        time: int | float | None = None,
        is_ground: Array | None = None,
        point_times: Array | None = None,
    ) -> FlowResult | None:
        """Add the sweep t+1 and return the flow of sweep t.

        Args:
            points: (N, 3+) float, metres, ego frame of this sweep; copied. Or a `Sweep`, which has all of these.
            pose: (4, 4) `T_world_ego`; None = estimate it from the points (extra `odometry`). Give poses for all sweeps
                of the stream, or for none.
            time: nanoseconds (int) or seconds (float); None = unknown. Give times for all sweeps, or for none.
            is_ground: (N,) bool ground mask; None = unknown.
            point_times: (N,) float, seconds of each point after the time stamp; None = unknown.

        Returns:
            Flow t -> t+1 of the points of the sweep before. None if there is no such sweep, or if this one comes late
            or repeats a time stamp.

        Raises:
            CFlowError: the input is not valid. The sweep is not added, and you can push the next one.

        Cost: the method for one window and, where needed, the ground and pose of one sweep.
        """
        if isinstance(points, Sweep):
            if any(value is not None for value in (pose, time, is_ground, point_times)):
                raise CFlowError("a Sweep and more are given: put pose, time, mask and point times into the Sweep")
            given = points
        else:
            given = Sweep(points, is_ground, pose, None if time is None else _nanoseconds(time), point_times)
        state = (self._sweeps.copy(), self._odometry, self.window)
        try:
            return self._add(given)
        except BaseException:
            self._sweeps, self._odometry, self.window = state
            raise

    def _add(self, given: Sweep) -> FlowResult | None:
        """Add a sweep, see `push`. An error may leave a part of the stream changed."""
        if not self._accepts(given.timestamp_ns):
            return None
        sweep = self._prepare(given)
        result = None
        if self._sweeps:
            before, *history = self._sweeps
            window = Window(before, sweep, tuple(history))
            (result,) = self._model([window])
            self._inspect([window])
            is_on_cpu = result.is_valid.device.type == "cpu"  # on a GPU, a stream does not wait for the result
            problem = self._watch(window, result) if is_on_cpu else ""
            if problem:
                warn(problem)
            self.window = window
        else:  # check it now, so that errors do not wait for the next sweep
            alone = replace(sweep, timestamp_ns=None)
            grid = self._model.grid(self.config.pixel_sizes[-1])
            windows = [Window(alone, alone)]
            device = torch.as_tensor(sweep.points).device
            make_batch(windows, self.config, grid, device, needs_times=True)
        self._sweeps.appendleft(sweep)
        return result

    def _accepts(self, stamp: int | None) -> bool:
        """Return False for late and repeated sweeps; start again after a gap."""
        newest = self._sweeps[0].timestamp_ns if self._sweeps else None
        if stamp is None or newest is None:
            return True
        gap = (stamp - newest) / 1e9
        if -self._max_gap <= gap <= 0:
            _log.warning("skipped a sweep: its time is %g s before that of the newest one", abs(gap))
            return False
        if abs(gap) > self._max_gap:
            _log.warning("the stream starts again: %g s from one sweep to the next, more than max_gap", gap)
            self.reset()
        return True

    def _prepare(self, sweep: Sweep) -> Sweep:
        """Check a sweep, copy it to the device, and add the ground and the pose that are missing."""
        check_windows([Window(sweep, sweep)], self.config)
        for newest in list(self._sweeps)[:1]:
            poses = (None if self._odometry else newest.pose, sweep.pose)
            for name, (known, given) in {"pose": poses, "time": (newest.timestamp_ns, sweep.timestamp_ns)}.items():
                if (known is None) != (given is None):
                    raise CFlowError(f"some sweeps of the stream have no {name}: give it for all sweeps, or for none")
        sweep, num_missing = without_missing(sweep)
        if num_missing and not self._has_told_missing:
            self._has_told_missing = True
            warn(f"{num_missing} {MISSING}, so we leave them out, also in later sweeps")
        device = choose_device([Window(sweep, sweep)], self._model.device)
        points = read_positions([sweep], device).t()
        is_ground = sweep.is_ground
        pose = sweep.pose
        times = sweep.point_times
        if is_ground is not None:
            is_ground = read_ground([sweep], device)
        elif self._ground is not None:
            is_ground = find_ground(points, self._ground)
            self._tell_ground(is_ground)
        if times is not None:
            times = float64_tensor(times, device).clone()  # the caller may use a tensor again
        if pose is None:
            self._odometry = self._odometry or Odometry()
            pose = self._odometry.next_pose(as_numpy(points), "the sweep")
        return Sweep(points, is_ground, as_numpy(pose).copy(), sweep.timestamp_ns, times)

    def _tell_ground(self, is_ground: Any) -> None:
        """Warn once that a sweep has no mask and that we found its ground."""
        if self._ground != "auto" or self._has_told_ground or not bool(is_ground.any()):
            return
        self._has_told_ground = True
        warn(
            "there is no ground mask for a sweep of the stream, so we find the ground. To turn this line off give "
            "masks (is_ground), ground='grid' (the same result), or ground=None if the clouds have no ground"
        )


def _nanoseconds(time: int | float) -> int:
    """Convert a time in nanoseconds (int) or seconds (float)."""
    with suppress(TypeError, ValueError, OverflowError):
        return round(time * 1e9) if isinstance(time, float) else operator.index(time)
    raise CFlowError(f"time={time!r}: give whole nanoseconds (int) or seconds (float), such as float(time)")
