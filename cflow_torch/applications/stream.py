"""Flow of sweeps as they arrive: `FlowStream`."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import replace
from typing import Any

import torch

from cflow_torch.config import Config, make_config
from cflow_torch.data.odometry import Odometry
from cflow_torch.estimate import GROUND, make_model
from cflow_torch.types import Array, CFlowError, FlowResult, Sweep, Window, as_numpy
from cflow_torch.windows.collation import make_batch
from cflow_torch.windows.ground import find_ground_batch
from cflow_torch.windows.validation import check_windows, choose_device, read_ground, read_positions

_log = logging.getLogger(__name__)


class FlowStream:
    """Sweeps in, one after the other; flow out as soon as the next sweep is there.

    It keeps the last `num_history` + 2 sweeps, on the device of the method, and nothing else. A result is that of
    `make_model(config)([window])` with these sweeps, to the bit.

    Args:
        preset: "default", "fast", "keypoints" or "paper", see `make_config`; no preset that asks for later sweeps.
        config: settings, from `make_config`, in place of a preset.
        device: "auto" = that of the tensors given, else a GPU if there is one, else the CPU.
        ground: None = as the masks say; "auto" or "patchwork" = find the ground of every sweep without a mask, once.
        max_gap: seconds; sweeps that are further apart are not compared: the stream begins anew.
        **overrides: any field of the settings.

    Attributes:
        window: the sweeps of the last result, None = there is none. `window.pc0` is what its rows belong to.

    Convention:
        Time stamps decide what happens. A repeated one and one that is older by up to `max_gap` (a late packet) are
        left out, with a note in the log. One that is older by more means that the clock was set back, one that is newer
        by more that sweeps were lost: the stream begins anew. Sweeps of a stream without time stamps follow each other
        by `sweep_interval`.

    Raises:
        CFlowError: an unknown setting; settings that ask for sweeps after t+1.

    Example:
        >>> stream = FlowStream("fast", sweep_interval=0.1)
        >>> for points, pose, time in sensor:
        ...     result = stream.push(points, pose, time)
        ...     if result is not None:
        ...         use(stream.window.pc0.points, result.residual_flow)
    """

    def __init__(
        self,
        preset: str | None = None,
        *,
        config: Config | None = None,
        device: Any = "auto",
        ground: str | None = None,
        max_gap: float = 0.5,
        **overrides: Any,
    ) -> None:
        if ground not in GROUND:
            raise CFlowError(f"ground={ground!r}: give one of {', '.join(map(repr, GROUND))}")
        if not max_gap > 0:
            raise CFlowError(f"max_gap={max_gap}: give seconds above 0")
        config = (config or make_config(preset)).replace(**overrides)
        if config.num_future > 0:
            raise CFlowError(
                f"num_future={config.num_future}: a stream does not know later sweeps; give another preset, or "
                "num_future=0"
            )
        self._model, self._ground, self._max_gap = make_model(config, device), ground, max_gap
        self._sweeps: deque[Sweep] = deque(maxlen=config.num_history + 1)
        self._odometry: Odometry | None = None
        self.window: Window | None = None

    @property
    def config(self) -> Config:
        """The settings of the method."""
        return self._model.config  # type: ignore[no-any-return]

    def reset(self) -> None:
        """Forget all sweeps, and the world of the odometry."""
        self._sweeps.clear()
        self._odometry = self.window = None

    def push(
        self,
        points: Array,
        pose: Array | None = None,
        time: int | float | None = None,
        is_ground: Array | None = None,
        point_times: Array | None = None,
    ) -> FlowResult | None:
        """Take the sweep t+1; give the flow of the sweep before it.

        Args:
            points: (N, 3+) float, metres, ego frame of this sweep; copied.
            pose: (4, 4) `T_world_ego`; None = from KISS-ICP (extra `odometry`), for all sweeps of the stream or none.
            time: nanoseconds (whole number) or seconds (float); None = not known, for all sweeps or none.
            is_ground, point_times: see `Sweep`.

        Returns:
            Flow t -> t+1 of the points of the sweep before; None = there is no such sweep, or this one is left out.

        Raises:
            CFlowError: bad input, see `make_batch`; the sweep is then left out and the stream goes on.

        Cost: that of the method for one window, and of finding ground and pose of one sweep where asked for.
        """
        stamp = None if time is None else round(time * 1e9) if isinstance(time, float) else int(time)
        if not self._is_next(stamp):
            return None
        sweep = self._ready(Sweep(points, is_ground, pose, stamp, point_times))
        if self._sweeps:
            before, *history = self._sweeps
            window = Window(before, sweep, tuple(history))
            (result,) = self._model([window])
            self.window = window
        else:
            alone = replace(sweep, timestamp_ns=None)  # what is wrong with it is said now, not at the next sweep
            grid = self._model.grid(self.config.pixel_sizes[-1])
            make_batch(
                [Window(alone, alone)], self.config, grid, torch.as_tensor(sweep.points).device, needs_times=True
            )
            result = None
        self._sweeps.appendleft(sweep)
        return result

    def _is_next(self, stamp: int | None) -> bool:
        """Whether a sweep follows the newest one; begins anew where it follows none."""
        newest = self._sweeps[0].timestamp_ns if self._sweeps else None
        if stamp is None or newest is None:
            return True
        gap = (stamp - newest) / 1e9
        if -self._max_gap <= gap <= 0:
            _log.warning("a sweep is left out: its time is %g s before that of the newest", -gap)
            return False
        if abs(gap) > self._max_gap:
            _log.warning("the stream begins anew: %g s from one sweep to the next (max_gap)", gap)
            self.reset()
        return True

    def _ready(self, sweep: Sweep) -> Sweep:
        """A copy of a sweep on the device, with ground and pose."""
        check_windows([Window(sweep, sweep)], self.config)
        for newest in list(self._sweeps)[:1]:
            poses = (None if self._odometry else newest.pose, sweep.pose)
            for name, (known, given) in {"pose": poses, "time": (newest.timestamp_ns, sweep.timestamp_ns)}.items():
                if (known is None) != (given is None):
                    raise CFlowError(
                        f"some sweeps of the stream have a {name} and some have none: give it for all, or none"
                    )
        device = choose_device([Window(sweep, sweep)], self._model.device)
        points = read_positions(sweep, device).t()
        is_ground, pose, times = sweep.is_ground, sweep.pose, sweep.point_times
        if is_ground is not None:
            is_ground = read_ground(sweep, "the sweep", len(points), device).clone()
        elif self._ground is not None:
            is_ground = find_ground_batch([points], "grid" if self._ground == "auto" else self._ground)[0]
        if times is not None:
            times = torch.as_tensor(times).to(device, copy=True)
        if pose is None:
            self._odometry = self._odometry or Odometry()
            pose = self._odometry.next_pose(as_numpy(points), "the sweep")
        return Sweep(points, is_ground, as_numpy(pose).copy(), sweep.timestamp_ns, times)
