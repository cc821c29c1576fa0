"""The protocol every reader speaks: a log is an ordered, lazy set of sweeps; windows slide over it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Iterator, Protocol, Sequence

import numpy as np
from torch.utils.data import Dataset

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
    """One drive: a sequence of sweeps. `len(log)`, `log[-1]` and `for sweep in log` work.

    A reader of one's own is a class that inherits from this one, sets `log_id` and `timestamps`, and has `sweep`.

    Attributes:
        log_id: name, safe as a folder name.
        timestamps: sweep times, ascending.

    Raises:
        CFlowError: from `sweep` and `labels`: there is no sweep of this number, or a file of it is missing, damaged, or
            of another size than what belongs to it. Other sweeps can be read then.
    """

    log_id: str
    timestamps: Sequence[int]

    def sweep(self, index: int) -> Sweep:
        """Sweep number `index` with float32 points, float64 pose `T_world_ego`, ground mask, time."""
        raise NotImplementedError

    def labels(self, index: int) -> FlowLabels | None:
        """Truth of the pair (index, index + 1), None where the log has none."""
        return None

    def __len__(self) -> int:
        return len(self.timestamps)

    def __getitem__(self, index: int) -> Sweep:
        return self.sweep(range(len(self))[index])

    def __iter__(self) -> Iterator[Sweep]:
        return map(self.sweep, range(len(self)))


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


def windows(log: Log, num_history: int = 0, num_future: int = 0) -> Iterator[Window]:
    """The window of every pair of a log, in order; each sweep is read once.

    Raises:
        CFlowError: a sweep cannot be read.
    """
    recent = CachedLog(log, num_history + num_future + 2)
    return (window(recent, index, num_history, num_future) for index in range(len(log.timestamps) - 1))


class WindowDataset(Dataset):  # type: ignore[type-arg]
    """The windows of some logs, for a `torch.utils.data.DataLoader`, whose workers then read the files.

    Args:
        logs: one or any number; each must be one that can be pickled, where the workers do not begin as forks.
        num_history, num_future: as in `window`.

    Example:
        >>> data = WindowDataset(logs, num_history=model.config.num_history)
        >>> loader = DataLoader(data, batch_size=4, num_workers=2, collate_fn=data.collate)
        >>> for batch in loader:
        ...     results = model(batch)
    """

    def __init__(self, logs: Log | Sequence[Log], num_history: int = 0, num_future: int = 0) -> None:
        several: Any = [logs] if hasattr(logs, "timestamps") else logs
        self._pairs = [(log, index) for log in several for index in range(len(log.timestamps) - 1)]
        self._num_history, self._num_future = num_history, num_future
        self._recent: CachedLog | None = None

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, number: int) -> Window:
        log, index = self._pairs[number]
        if self._recent is None or self._recent.log is not log:
            self._recent = CachedLog(log, self._num_history + self._num_future + 2)
        return window(self._recent, index, self._num_history, self._num_future)

    @staticmethod
    def collate(windows: Sequence[Window]) -> list[Window]:
        """A batch, as models take it: sweeps differ in their numbers of points, so nothing is stacked."""
        return list(windows)


class NumberedSweeps(Log):
    """What readers share: sweeps are asked for by number."""

    def _timestamp(self, index: int) -> int:
        """Time stamp of sweep `index`; refuses a number that no sweep has."""
        if not 0 <= index < len(self.timestamps):
            raise CFlowError(f"log {self.log_id} has sweeps 0 ... {len(self) - 1}, asked for {index}")
        return self.timestamps[index]

    def _check_count(self, where: Any) -> None:
        """Refuse a log without a pair of sweeps; `where` begins the message."""
        if len(self.timestamps) < 2:
            raise CFlowError(f"{where} has {len(self.timestamps)} sweeps; scene flow needs two or more")


class LogWrapper(Log):
    """Another log whose sweeps are changed; everything else is the other's.

    Args:
        log: any log.
    """

    def __init__(self, log: Log) -> None:
        self.log, self.log_id, self.timestamps = log, log.log_id, log.timestamps

    def labels(self, index: int) -> FlowLabels | None:
        """The log's labels."""
        return self.log.labels(index)

    def __getattr__(self, name: str) -> Any:
        if name == "log" or name.startswith("__"):  # it is being unpickled; what Python asks of a class
            raise AttributeError(name)
        return getattr(self.log, name)


class CachedLog(LogWrapper):
    """A log that remembers its last sweeps: neighbouring windows share all but one.

    Args:
        log: any log.
        count: sweeps to remember.
    """

    def __init__(self, log: Log, count: int) -> None:
        super().__init__(log)
        self._count = count
        self._sweep = lru_cache(count)(log.sweep)

    def __reduce__(self) -> Any:
        return CachedLog, (self.log, self._count)

    def sweep(self, index: int) -> Sweep:
        """The log's sweep."""
        return self._sweep(index)
