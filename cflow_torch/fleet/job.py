"""A run, the share of this process, the units of work, and the events that workers report."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Mapping, NamedTuple, Sequence, Union

from cflow_torch.config import Config
from cflow_torch.data.flow_file import CONTENTS
from cflow_torch.fleet.machine import AUTO
from cflow_torch.types import CFlowError

# Units per worker, so that the last unit does not keep the other workers waiting for long. A log is divided only if
# there are too few logs, because each piece reads num_history + 1 sweeps that its neighbour reads as well.
_UNITS_PER_WORKER = 2


@dataclass(frozen=True)
class Job:
    """The settings of a run, which every worker gets. The units of work are sent separately."""

    config: Config  # settings of the method
    identity: str  # hash of method, data settings and versions, see `cflow_torch.fleet.manifest`
    reader: str  # data set, a key of `catalog.DATA_SETS`
    settings: dict[str, Any]  # of its reader
    output: str  # folder of the results; a path, or the address of an object store
    contents: tuple[str, ...] = CONTENTS  # what a flow file has: names in `flow_file.CONTENTS` and `ON_REQUEST`
    batch: int = 1  # windows that are computed together
    redo: bool = False  # compute frames again that exist already


@dataclass(frozen=True)
class Unit:
    """Consecutive frames of one log: the work that a worker gets at once."""

    number: int  # index among the units of a run
    source: Any  # its log, one of `catalog.find_sources`
    first: Fraction = Fraction(0)  # share of the log's pairs before the first frame, 0 ... 1
    last: Fraction = Fraction(1)  # share of the log's pairs before the end of the unit
    only: frozenset[int] | None = None  # time stamps of the frames to do; None = all of them
    deaths: int = 0  # number of workers that have died on it

    def frames(self, num_pairs: int) -> range:
        """Indices of the sweeps t, in a log of `num_pairs` pairs."""
        return range(int(self.first * num_pairs), int(self.last * num_pairs))


class Opened(NamedTuple):
    """A unit has begun. `frames` are the time stamps of its frames, `todo` the time stamps of incomplete frames."""

    unit: int
    log_id: str
    frames: tuple[int, ...]
    todo: tuple[int, ...]


class Done(NamedTuple):
    """A frame is on disk. `seconds` by stage; "compute" is the time of its batch, divided by the number of frames."""

    unit: int
    timestamp: int
    seconds: dict[str, float]


class Failed(NamedTuple):
    """A frame has no result. If `timestamp` is None, the unit or the rest of it has none."""

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


@dataclass(frozen=True)
class Shard:
    """Share `index`, 0 ... `count` - 1, of a run that is divided into `count` shares."""

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.index < self.count:
            raise CFlowError(f"shard.index={self.index} of shard.count={self.count}: give 0 ... count - 1")

    def units(self, sources: Sequence[Any], workers: int = 1) -> list[Unit]:
        """Divide this shard's share of the logs into units, numbered from 0, enough of them for all workers.

        The sequence of all logs is divided into `count` parts of equal length. So a shard opens only its own logs, and
        shares at most the first and the last of them with a neighbour.
        """
        begin, end = (Fraction(edge * len(sources), self.count) for edge in (self.index, self.index + 1))
        logs = range(math.floor(begin), math.ceil(end))
        pieces = -(-_UNITS_PER_WORKER * workers // len(logs)) if logs and workers > 1 else 1
        units: list[Unit] = []
        for log in logs:
            first, last = max(begin - log, Fraction(0)), min(end - log, Fraction(1))
            edges = [first + (last - first) * k / pieces for k in range(pieces + 1)]
            units += [Unit(len(units) + k, sources[log], edges[k], edges[k + 1]) for k in range(pieces)]
        return units


def find_shard(index: Any, count: Any, environ: Mapping[str, str]) -> Shard:
    """Return the shard of this process. `index` counts from 0; both arguments may be "auto".

    "auto" reads the environment variables: RANK and WORLD_SIZE of torchrun, or the task of an `srun` step. In a SLURM
    array, we combine it with the task of the array. Without these variables, this is the only shard.
    """
    if index != AUTO and count == AUTO:
        raise CFlowError(f"shard.index={index} is given without shard.count: give both")
    shard = _from_environment(environ) if index == AUTO else Shard(index, count)
    if count not in (AUTO, shard.count):
        found = f"the environment sets {shard.count}"
        raise CFlowError(f"shard.count={count} processes, but {found}: give shard.index as well")
    return shard


def _from_environment(environ: Mapping[str, str]) -> Shard:
    """Return the shard that torchrun or SLURM gives this process, or the only one.

    A SLURM batch script is not a task of a step: only `srun` sets SLURM_STEP_NUM_TASKS. Without `srun`, a script with
    `--ntasks=8` runs once, so it must compute everything.
    """
    index, count = 0, 1
    if "SLURM_ARRAY_TASK_ID" in environ:
        task = int(environ["SLURM_ARRAY_TASK_ID"])
        index = (task - int(environ.get("SLURM_ARRAY_TASK_MIN", 0))) // int(environ.get("SLURM_ARRAY_TASK_STEP", 1))
        count = int(environ.get("SLURM_ARRAY_TASK_COUNT", index + 1))
        if index >= count or (count == 1 and task > 0):
            raise CFlowError(
                f"this SLURM array has {count} tasks, and this one is number {task}: give the array a range without "
                "gaps, or give shard.index and shard.count"
            )
    for rank, tasks in (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS")):
        if rank in environ and tasks in environ:
            return Shard(index * int(environ[tasks]) + int(environ[rank]), count * int(environ[tasks]))
    return Shard(index, count)
