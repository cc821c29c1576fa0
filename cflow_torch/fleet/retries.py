"""What is done again after a worker died: its unit, then each frame of the unit by itself, then nothing."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any, List, Set, Tuple

from cflow_torch.fleet.counters import Waiting
from cflow_torch.fleet.job import Event, Failed, Unit
from cflow_torch.fleet.work import source_name

# Workers that may die on one unit; then the rest of it is left. All its frames may be too large for the memory, and a
# new worker takes seconds to start.
_MOST_OF_UNIT = 10


class Retries:
    """Follows the events of a run, and answers for a unit whose worker died.

    Frames are written whole or not at all, so that a unit can be done again without harm; what is complete is skipped.

    Args:
        retries: how often a unit is done again, and then each of its frames by itself.
    """

    def __init__(self, retries: int) -> None:
        self._retries, self._most_of_unit = retries, max(_MOST_OF_UNIT, 2 * (retries + 1))
        self._waiting = Waiting()
        self._deaths: Counter[Any] = Counter()  # (unit number, time stamp, or None for the unit as a whole) -> workers
        self._of_units: Counter[int] = Counter()  # unit number -> workers that died on it or its frames
        self._given_up: Set[int] = set()  # unit numbers

    def follow(self, event: Event) -> None:
        """An event of a worker that lives."""
        self._waiting.settle(event)

    def is_given_up(self, unit: Unit) -> bool:
        """Whether what is left of the unit is not to be done any more."""
        return unit.number in self._given_up

    def on_failure(self, unit: Unit, how: str) -> Tuple[List[Failed], List[Unit]]:
        """A worker died on a unit.

        Args:
            unit: as it was given to the worker.
            how: the worker died.

        Returns:
            What is given up, and what is to be done again.
        """
        if self.is_given_up(unit):
            return [], []
        number = unit.number
        log_id = self._waiting.log_ids.get(number, source_name(unit.source))
        stamps = sorted(self._waiting.stamps.get(number, set()))
        stamps = [stamp for stamp in stamps if unit.only is None or stamp in unit.only]
        is_opened = number in self._waiting.stamps
        if is_opened and not stamps:
            return [], []
        frame = stamps[0] if len(stamps) == 1 else None
        self._deaths[number, frame] += 1
        self._of_units[number] += 1
        if self._of_units[number] >= self._most_of_unit:
            self._given_up.add(number)
            message = f"{self._of_units[number]} workers died on this part of the log, {how}: the rest of it is left"
            return [Failed(number, log_id, message)], []
        if self._deaths[number, frame] <= self._retries:
            return [], [replace(unit, only=frozenset(stamps)) if is_opened else unit]
        if frame is None and is_opened:
            return [], [replace(unit, only=frozenset([stamp])) for stamp in stamps]
        deaths = self._deaths[number, frame]
        message = f"{deaths} worker{'s' * (deaths > 1)} died on it, {how}"
        name = log_id if frame is None else f"{log_id}/{frame}"
        return [Failed(number, name, message, frame)], []
