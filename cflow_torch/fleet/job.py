"""A run, the share of this process, the units of work, and the events that workers report."""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, Mapping, NamedTuple, Sequence, Union

from cflow_torch.config import Config
from cflow_torch.data.flow_file import CONTENTS
from cflow_torch.fleet.machine import AUTO
from cflow_torch.types import CFlowError

# Units per worker, so that the last unit does not keep the other workers waiting for long. A log is divided only if
# there are too few logs, because each piece reads h + 1 sweeps that its neighbour reads as well.
_UNITS_PER_WORKER = 2


@dataclass(frozen=True)
class Job:
    """What every worker gets to know about a run. The units of work are sent separately."""

    config: Config  # settings of the method
    identity: str  # hash of method, data settings and versions, see `cflow_torch.fleet.manifest`
    reader: str  # data set, a key of `catalog.DATA_SETS`
    settings: dict[str, Any]  # of its reader
    output: str  # folder of the results; a path, or the address of an object store
    contents: tuple[str, ...] = CONTENTS  # of a flow file, names of `flow_file.CONTENTS` and `ON_REQUEST`
    batch: int = 1  # windows that are computed together
    redo: bool = False  # compute frames that exist already


@dataclass(frozen=True)
class Unit:
    """Consecutive frames of one log: the work that a worker gets at once."""

    number: int  # index among the units of a run
    source: Any  # one of `catalog.find_sources`
    first: Fraction = Fraction(0)  # share of the log's pairs before the first frame, 0 ... 1
    last: Fraction = Fraction(1)  # share before the end
    only: frozenset[int] | None = None  # time stamps of the frames to do; None = all of them
    deaths: int = 0  # number of workers that have died on it

    def frames(self, num_pairs: int) -> range:
        """Indices of the sweeps t, in a log of `num_pairs` pairs."""
        return range(int(self.first * num_pairs), int(self.last * num_pairs))


class Opened(NamedTuple):
    """A unit has begun: time stamps of its `frames`, and of those `todo` that are not complete yet."""

    unit: int
    log_id: str
    frames: tuple[int, ...]
    todo: tuple[int, ...]


class Done(NamedTuple):
    """A frame is on disk. `seconds` by stage are those of its batch, divided by the number of frames."""

    unit: int
    timestamp: int
    seconds: dict[str, float]


class Failed(NamedTuple):
    """A frame has no result; `timestamp` None: the whole unit has none."""

    unit: int
    name: str
    message: str
    timestamp: int | None = None


class Noted(NamedTuple):
    """Something that a user should know about a log, or about a worker."""

    unit: int
    name: str
    message: str


Event = Union[Opened, Done, Failed, Noted]


def split(units: Sequence[Unit], workers: int) -> list[Unit]:
    """Split units until there are enough of them for all workers, and number them from 0."""
    count = -(-_UNITS_PER_WORKER * workers // max(1, len(units))) if workers > 1 else 1
    pieces = []
    for unit in units:
        length = (unit.last - unit.first) / count
        edges = [unit.first + length * k for k in range(count + 1)]
        pieces += [replace(unit, first=first, last=last) for first, last in zip(edges, edges[1:])]
    return [replace(unit, number=number) for number, unit in enumerate(pieces)]


@dataclass(frozen=True)
class Shard:
    """Share number `index`, 0 ... `count` - 1, of `count`."""

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1 or not 0 <= self.index < self.count:
            allowed = "a count of at least 1 and an index of 0 ... count - 1"
            raise CFlowError(f"shard.index={self.index} of shard.count={self.count}: give {allowed}")

    def units(self, sources: Sequence[Any]) -> list[Unit]:
        """Return this shard's share of the logs.

        The sequence of all logs is divided into `count` parts of equal length. So a shard opens only its own logs, and
        shares at most the first and the last of them with a neighbour.
        """
        begin, end = (Fraction(edge * len(sources), self.count) for edge in (self.index, self.index + 1))
        units: list[Unit] = []
        for number, source in enumerate(sources):
            first, last = max(begin - number, Fraction(0)), min(end - number, Fraction(1))
            if first < last:
                units.append(Unit(len(units), source, first, last))
        return units


def find_shard(index: Any, count: Any, environ: Mapping[str, str]) -> Shard:
    """Return the shard of this process. `index` counts from 0; both arguments may be "auto".

    "auto" reads the environment variables: RANK and WORLD_SIZE of torchrun, or the task of an `srun` step. In a SLURM
    array, we combine it with the task of the array. Without any of them this is the only shard.
    """
    if index != AUTO and count == AUTO:
        raise CFlowError(f"shard.index={index} is given without shard.count: give both")
    if index != AUTO:
        return Shard(_number("shard.index", index), _number("shard.count", count))
    found = _from_environment(environ)
    wanted = None if count == AUTO else _number("shard.count", count)
    if wanted not in (None, found.count if found else 1):
        tasks = f"{found.count} tasks" if found else "no number of tasks"
        raise CFlowError(f"shard.count={wanted}, but the environment sets {tasks}: give shard.index as well")
    return found or Shard()


def _from_environment(environ: Mapping[str, str]) -> Shard | None:
    """Return the shard that torchrun or SLURM gives this process; None if neither does.

    A SLURM batch script is not a task of a step: only `srun` sets SLURM_STEP_NUM_TASKS. Without `srun`, a script with
    `--ntasks=8` must not compute one eighth.
    """

    def value(name: str, default: Any = None) -> int:
        return _number(name, environ.get(name, default))

    index, count, is_array = 0, 1, "SLURM_ARRAY_TASK_ID" in environ
    if is_array:
        task = value("SLURM_ARRAY_TASK_ID")
        index = (task - value("SLURM_ARRAY_TASK_MIN", 0)) // value("SLURM_ARRAY_TASK_STEP", 1)
        count = value("SLURM_ARRAY_TASK_COUNT", index + 1)
        if index >= count or (count == 1 and task > 0):
            raise CFlowError(
                f"this SLURM array has {count} tasks, and this one is number {task}: give the array a range without "
                "gaps, or give shard.index and shard.count"
            )
    for rank, tasks in (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS")):
        if rank in environ and tasks in environ:
            return Shard(index * value(tasks) + value(rank), count * value(tasks))
    return Shard(index, count) if is_array else None


def _number(name: str, value: Any) -> int:
    try:
        return int(str(value))
    except ValueError:
        raise CFlowError(f"{name}={value!r}: give a whole number") from None
