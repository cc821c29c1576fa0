"""What a run has done so far, from the events of its workers."""

from __future__ import annotations

from typing import Dict, List, Sequence, Set, Tuple

from cflow_torch.fleet.job import Done, Event, Failed, Opened, Unit


class Tally:
    """Counts frames, each once, however often its unit was begun.

    Args:
        units: what was asked for.
    """

    def __init__(self, units: Sequence[Unit]) -> None:
        self.total = 0  # frames of the units that were opened
        self.complete_before = 0
        self.computed = 0
        self.failures: List[Tuple[str, str]] = []  # (frame or log, message)
        self.num_failed_frames = 0
        self.seconds: Dict[str, float] = {}  # by stage, of all workers together
        self._open: Dict[int, Tuple[str, Set[int]]] = {}  # unit -> log id, time stamps neither on disk nor failed
        self.log_ids: Set[str] = set()  # of which frames are on disk
        self._unopened = {unit.number for unit in units}

    @property
    def num_unopened(self) -> int:
        """Units that were never begun."""
        return len(self._unopened)

    @property
    def waiting(self) -> List[str]:
        """Frames of opened units that are neither on disk nor failed, in order."""
        return [f"{log_id}/{stamp}" for log_id, stamps in self._open.values() for stamp in sorted(stamps)]

    @property
    def is_complete(self) -> bool:
        """Every frame is on disk."""
        return not (self.failures or self._unopened or any(stamps for _, stamps in self._open.values()))

    def add(self, event: Event) -> int:
        """Count an event in; returns the frames that it settles (on disk, or failed)."""
        if isinstance(event, Opened):
            return self._opened(event)
        if isinstance(event, Done):
            for stage, seconds in event.seconds.items():
                self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
            self.computed += 1
            self.log_ids.add(self._open[event.unit][0])
            return self._settle(event.unit, {event.timestamp})
        if isinstance(event, Failed):
            self.failures.append((event.name, event.message))
            self._unopened.discard(event.unit)
            self.num_failed_frames += event.timestamp is not None
            return 0 if event.timestamp is None else self._settle(event.unit, {event.timestamp})
        return 0

    def _opened(self, event: Opened) -> int:
        todo = set(event.todo)
        if event.unit in self._open:  # begun again: what is no more to be done got its name before its worker died
            found = self._open[event.unit][1] - todo
            self.computed += len(found)
            return self._settle(event.unit, found)
        self._unopened.discard(event.unit)
        self._open[event.unit] = (event.log_id, todo)
        if len(todo) < event.total:
            self.log_ids.add(event.log_id)
        self.total += event.total
        self.complete_before += event.total - len(todo)
        return event.total - len(todo)

    def _settle(self, unit: int, stamps: Set[int]) -> int:
        self._open[unit][1].difference_update(stamps)
        return len(stamps)
