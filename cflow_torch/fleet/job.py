"""What is to be done, in pieces small enough to be sent to any machine, and what comes back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Dict, FrozenSet, List, Optional, Sequence, Tuple, Union

from cflow_torch.config import Config
from cflow_torch.data.flow_file import CONTENTS

# Units per worker, so that the last one does not keep the others waiting long. A log is cut only if there are too few
# logs: each piece reads h + 1 sweeps that its neighbour reads as well.
_UNITS_PER_WORKER = 2


@dataclass(frozen=True)
class Job:
    """One run. Everything a worker needs besides its units.

    Args:
        config: settings of the method.
        identity: hash of method, data settings and versions, see `cflow_torch.fleet.manifest`.
        reader: data set, a key of `catalog.DATA_SETS`.
        settings: of its reader.
        output: folder of the results; a path, or the address of an object store.
        contents: of a flow file, names of `flow_file.CONTENTS` and `ON_REQUEST`.
        batch: windows that are computed together.
        redo: compute frames that are there already.
        check: warn of logs whose static world does not stay put.
    """

    config: Config
    identity: str
    reader: str
    settings: Dict[str, Any]
    output: str
    contents: Tuple[str, ...] = CONTENTS
    batch: int = 1
    redo: bool = False
    check: bool = True


@dataclass(frozen=True)
class Unit:
    """A span of consecutive frames of one log: what one worker does at a time.

    Args:
        number: position among the units of a run.
        source: one of `catalog.find_sources`.
        first: share of the log's pairs that lies before the span, 0 ... 1.
        last: share that lies before its end.
        only: time stamps of the frames of the span that are to be done; None = all of them.
        deaths: workers that have died on it.
    """

    number: int
    source: Any
    first: Fraction = Fraction(0)
    last: Fraction = Fraction(1)
    only: Optional[FrozenSet[int]] = None
    deaths: int = 0

    def frames(self, num_pairs: int) -> range:
        """Numbers of the sweeps t of the span, in a log of so many pairs."""
        return range(int(self.first * num_pairs), int(self.last * num_pairs))


@dataclass(frozen=True)
class Opened:
    """A unit has begun: time stamps of its `frames`, and of those `todo` that are not complete yet."""

    unit: int
    log_id: str
    frames: Tuple[int, ...]
    todo: Tuple[int, ...]


@dataclass(frozen=True)
class Done:
    """A frame is on disk under its name. `seconds` by stage, of this frame's share of its batch."""

    unit: int
    timestamp: int
    seconds: Dict[str, float]


@dataclass(frozen=True)
class Failed:
    """A frame that has no result and why; `timestamp` None: the whole unit."""

    unit: int
    name: str
    message: str
    timestamp: Optional[int] = None


Event = Union[Opened, Done, Failed]


def split(units: Sequence[Unit], workers: int) -> List[Unit]:
    """The same frames in enough units to keep all workers busy, numbered from 0."""
    parts = -(-_UNITS_PER_WORKER * workers // max(1, len(units))) if workers > 1 else 1
    pieces = []
    for unit in units:
        length = (unit.last - unit.first) / parts
        edges = [unit.first + length * part for part in range(parts + 1)]
        pieces += [replace(unit, first=first, last=last) for first, last in zip(edges, edges[1:])]
    return [replace(unit, number=number) for number, unit in enumerate(pieces)]
