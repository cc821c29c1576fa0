"""Who died on what: frames and units that kill their workers are given up, everything else is done again."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Collection, Dict, List, Optional, Set, Tuple

from cflow_torch.fleet.job import Failed, Unit

# Workers that may die on one unit; then the rest of it is left. All its frames may be too large for the memory, and
# a new worker takes seconds to start.
_MOST_OF_UNIT = 10


class Deaths:
    """Counts workers that died.

    Args:
        most: of them on one frame, or on one unit before its first frame; then it is given up.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._counts: Dict[Any, int] = {}  # (unit number, time stamp or None) -> workers that died on it
        self._of_units: Dict[int, int] = {}  # unit number -> workers that died on it

    def settle(self, unit: int) -> None:
        """A frame of the unit came to its end: the unit can be begun."""
        self._counts.pop((unit, None), None)

    def blame(
        self, unit: Unit, name: str, in_hand: Collection[int], settled: Set[int], how: str
    ) -> Tuple[List[Failed], Optional[Unit]]:
        """A worker died.

        Args:
            unit: that it worked on.
            name: of the log.
            in_hand: time stamps of frames that were begun and not settled.
            settled: of those that are on disk or failed: with `redo`, files do not tell.
            how: it died.

        Returns:
            What is given up; what is to be done again, None = nothing.
        """
        failed: List[Failed] = []
        given_up: Set[int] = set()
        for stamp in in_hand or [None]:  # type: ignore[list-item]
            deaths = self._counts[unit.number, stamp] = self._counts.get((unit.number, stamp), 0) + 1
            # While several frames were in hand, each is only a suspect.
            if deaths >= self._most and len(in_hand) <= 1:
                message = f"{deaths} worker{'s' * (deaths > 1)} died on it, {how}"
                failed.append(Failed(unit.number, name if stamp is None else f"{name}/{stamp}", message, stamp))
                if stamp is None:
                    return failed, None
                given_up.add(stamp)
        total = self._of_units[unit.number] = self._of_units.get(unit.number, 0) + 1
        if total >= max(_MOST_OF_UNIT, self._most):
            message = f"{total} workers died on this part of the log, {how}: the rest of it is left"
            return [*failed, Failed(unit.number, name, message)], None
        skip = unit.skip | given_up | settled
        return failed, replace(unit, careful=unit.careful | set(in_hand), skip=skip)
