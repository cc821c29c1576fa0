"""What a run has done so far, from the events of its workers."""

from __future__ import annotations

from typing import Dict, List, Sequence, Set, Tuple

from cflow_torch.fleet.job import Done, Event, Failed, Opened, Unit


class Waiting:
    """Frames of each opened unit that are neither on disk nor failed."""

    def __init__(self) -> None:
        self.log_ids: Dict[int, str] = {}  # unit number -> log
        self.stamps: Dict[int, Set[int]] = {}  # unit number -> time stamps

    def settle(self, event: Event) -> Set[int]:
        """Follow an event; returns the time stamps of the frames that it settles.

        A unit may be opened again after its worker died: what is no longer to be done got its name before.
        """
        if isinstance(event, Opened):
            self.log_ids[event.unit] = event.log_id
            waiting = self.stamps.setdefault(event.unit, set(event.frames))
            settled = waiting & set(event.frames) - set(event.todo)
        else:
            waiting = self.stamps.get(event.unit, set())
            settled = waiting & {event.timestamp}
        waiting -= settled
        return settled


class Counters:
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
        self.log_ids: Set[str] = set()  # of which frames are on disk
        self._waiting = Waiting()
        self._unopened = {unit.number for unit in units}

    @property
    def num_opened(self) -> int:
        """Units that were begun."""
        return len(self._waiting.stamps)

    @property
    def num_unopened(self) -> int:
        """Units that were never begun."""
        return len(self._unopened)

    @property
    def waiting(self) -> List[str]:
        """Frames of opened units that are neither on disk nor failed, in order."""
        opened = self._waiting
        return [f"{opened.log_ids[unit]}/{stamp}" for unit, stamps in opened.stamps.items() for stamp in sorted(stamps)]

    @property
    def is_complete(self) -> bool:
        """Every frame is on disk."""
        return not (self.failures or self._unopened or any(self._waiting.stamps.values()))

    def add(self, event: Event) -> int:
        """Count an event in; returns the number of frames that it settles (on disk, or failed)."""
        was_open = event.unit in self._waiting.stamps
        settled = len(self._waiting.settle(event))
        self._unopened.discard(event.unit)
        if isinstance(event, Failed):
            self.failures.append((event.name, event.message))
            self.num_failed_frames += event.timestamp is not None
            return settled
        if settled:
            self.log_ids.add(self._waiting.log_ids[event.unit])
        if isinstance(event, Opened) and not was_open:
            self.total += len(event.frames)
            self.complete_before += settled
        else:
            self.computed += settled
        if isinstance(event, Done):
            for stage, seconds in event.seconds.items():
                self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds
        return settled
