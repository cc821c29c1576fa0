"""The sweeps of a batch in order: their steps, times and transforms. Plain numbers, no points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from cflow_torch.config import Config
from cflow_torch.types import Sweep, Window
from cflow_torch.windows.bev_grid import Grid
from cflow_torch.windows.ego_motion import rigid_transform
from cflow_torch.windows.point_times import has_point_times
from cflow_torch.windows.validation import check_distance, elapsed_times, keep_nearest, source_sweeps


@dataclass(frozen=True)
class Entry:
    """One sweep of one window.

    Args:
        step: 0 = t+1, 1 = t, 2 = t-1, ..., then t+2, t+3, ...
        window: which.
        name: as users know it, for errors.
        sweep: the sweep.
        T_ego1_ego: (4, 4) float64; None = its points lie in the frame of t+1.
        interval: seconds from t to t+1; None = the times of its points do not count.
    """

    step: int
    window: int
    name: str
    sweep: Sweep
    T_ego1_ego: np.ndarray | None
    interval: float | None


@dataclass(frozen=True)
class Timeline:
    """All sweeps of B windows: t+1 of every window first, then t of every window, then t-1, ...

    Args:
        entries: the sweeps.
        table: (5, B, S) float64: `elapsed`, `seconds` and x, y, z of `origin`, as in `Batch`.
    """

    entries: list[Entry]
    table: np.ndarray

    @staticmethod
    def of(windows: Sequence[Window], config: Config, grid: Grid, needs_times: bool) -> Timeline:
        """The timeline of windows; all but their points is checked here. Arguments and errors as in `make_batch`."""
        windows = [keep_nearest(window, config.num_history) for window in windows]
        kept = [source_sweeps(window, config) for window in windows]
        num_future = [sum(way < 0 for _, _, way in sources) for sources in kept]
        first_future = 1 + max(len(sources) - count for sources, count in zip(kept, num_future))
        num_steps = first_future + max(num_future)
        table = np.zeros((5, len(windows), num_steps))
        farthest = max(map(abs, (*grid.lower[:2], *grid.upper[:2])))
        entries: list[Entry] = []
        for index, (window, sources, count) in enumerate(zip(windows, kept, num_future)):
            steps = [*range(1, 1 + len(sources) - count), *range(first_future, first_future + count)]
            times = elapsed_times(window, sources, config)
            table[:2, index, steps] = np.transpose(times)
            has_times = needs_times and has_point_times(window, sources)
            interval = times[0][1] / times[0][0] if has_times else None
            pose1, transform = window.pc1.pose, None
            T_ego1_world = None if pose1 is None else np.linalg.inv(rigid_transform(pose1, "pose1", farthest))
            entries.append(Entry(0, index, "pc1", window.pc1, None, interval))
            for step, (name, sweep, _) in zip(steps, sources):
                if T_ego1_world is not None:
                    transform = T_ego1_world @ rigid_transform(sweep.pose, f"pose of {name}", farthest)
                    check_distance(transform, name)
                    table[2:, index, step] = transform[:3, 3]
                entries.append(Entry(step, index, name, sweep, transform, interval))
        return Timeline(sorted(entries, key=lambda entry: entry.step), table)
