"""The protocol every reader speaks: a log is an ordered, lazy set of sweeps; windows slide over it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Optional, Protocol, Sequence

import numpy as np

from cflow_torch.types import CFlowError, Sweep, Window


@dataclass(frozen=True)
class FlowLabels:
    """Ground truth of one pair of sweeps, rows in the order of sweep t.

    Args:
        flow: (N, 3) float32, metres, TOTAL flow t -> t+1 (ego motion included), axes of ego1.
        category: (N,) uint8, Argoverse 2 index 1 ... 30, 0 = background.
        is_valid: (N,) bool, False where the truth is unknown.
    """

    flow: np.ndarray
    category: np.ndarray
    is_valid: np.ndarray


class Log(Protocol):
    """One drive.

    Raises:
        CFlowError: from `sweep` and `labels`: there is no sweep of this number, or a file of it is missing, damaged, or
            of another size than what belongs to it. Other sweeps can be read then.
    """

    @property
    def log_id(self) -> str:
        """Name, safe as a folder name."""

    @property
    def timestamps(self) -> Sequence[int]:
        """Sweep times, ascending."""

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index` with float32 points, float64 pose `T_world_ego`, ground mask, time."""

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Truth of the pair (index, index + 1), None where the log has none."""


def window(log: Log, index: int, num_history: int = 0, num_future: int = 0) -> Window:
    """The window whose flow is that of sweep `index` to sweep `index + 1`.

    At the start of a log fewer than `num_history` sweeps exist before it, at its end fewer than `num_future` after
    `index + 1`; the window is then shorter.

    Raises:
        CFlowError: `index` has no successor, or a sweep cannot be read.
    """
    if not 0 <= index < len(log.timestamps) - 1:
        raise CFlowError(
            f"log {log.log_id} has {len(log.timestamps)} sweeps; a pair needs 0 <= index < "
            f"{len(log.timestamps) - 1}, got {index}"
        )
    history = range(index - 1, max(index - 1 - num_history, -1), -1)
    future = range(index + 2, min(index + 2 + num_future, len(log.timestamps)))
    past, later = (tuple(log.sweep(i) for i in indices) for indices in (history, future))
    return Window(log.sweep(index), log.sweep(index + 1), past, later)


class NumberedSweeps:
    """What readers share: sweeps are asked for by number."""

    log_id: str
    timestamps: Sequence[int]

    def __len__(self) -> int:
        return len(self.timestamps)

    def _timestamp(self, index: int) -> int:
        """Time stamp of sweep `index`; refuses a number that no sweep has."""
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"log {self.log_id} has sweeps 0 ... {len(self) - 1}, asked for {index}")
        return self.timestamps[index]

    def _check_count(self, where: Any) -> None:
        """Refuse a log without a pair of sweeps; `where` begins the message."""
        if len(self.timestamps) < 2:
            raise CFlowError(f"{where} has {len(self.timestamps)} sweeps; scene flow needs two or more")


class RecentSweeps:
    """A log that remembers its last sweeps: neighbouring windows share all but one.

    Args:
        log: any log.
        count: sweeps to remember.
    """

    def __init__(self, log: Log, count: int) -> None:
        self.log, self.log_id, self.timestamps, self.labels = log, log.log_id, log.timestamps, log.labels
        self.sweep = lru_cache(count)(log.sweep)
