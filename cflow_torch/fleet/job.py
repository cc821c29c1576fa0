"""A run, the share of this process, the parts of logs, and the events that workers report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Mapping, NamedTuple, Sequence, Union

from cflow_torch.config import Config
from cflow_torch.data.flow_file import CONTENTS
from cflow_torch.data.log import Log
from cflow_torch.fleet.manifest import make_identity
from cflow_torch.setting import AUTO
from cflow_torch.types import CFlowError

# So that the last part does not keep the other workers waiting for long. A log is divided only if there are too few
# logs, because each part reads num_history + 1 sweeps that its neighbour reads as well.
_PARTS_PER_WORKER = 2


@dataclass(frozen=True)
class Job:
    """The settings of a run, which every worker gets. The parts are sent separately."""

    config: Config  # settings of the method
    reader: str  # data set, a key of `catalog.DATA_SETS`
    settings: dict[str, Any]  # of its reader
    output: str  # folder of the results; a path, or the address of an object store
    contents: tuple[str, ...] = CONTENTS  # what a flow file has: names in `flow_file.CONTENTS` and `ON_REQUEST`
    batch: int = 1  # windows that are computed together
    redo: bool = False  # compute frames again that exist already
    identity: dict[str, Any] = field(init=False)  # method, data settings and versions, see `make_identity`

    def __post_init__(self) -> None:
        identity = make_identity(self.config, self.reader, self.settings, self.contents)
        object.__setattr__(self, "identity", identity)


@dataclass(frozen=True)
class Part:
    """Consecutive frames of one log: the work that a worker gets at once."""

    source: Any  # its log, one of `catalog.find_sources`
    begin: int = 0  # the frames lie between begin / of and end / of of the log
    end: int = 1
    of: int = 1
    only: str | None = None  # name of the only frame to do; None = all of them

    def frames(self, num_pairs: int) -> range:
        """Indices of the sweeps t, in a log of `num_pairs` pairs."""
        return range(self.begin * num_pairs // self.of, self.end * num_pairs // self.of)

    def stamps(self, log: Log) -> dict[int, int]:
        """Return the time stamp of each sweep t by its index; the pair over a gap of the log is not a frame."""
        stamps = {i: int(log.timestamps[i]) for i in self.frames(len(log.timestamps) - 1) if i not in log.gaps}
        return {i: stamp for i, stamp in stamps.items() if self.only in (None, frame_name(log, stamp))}


def frame_name(log: Log, timestamp: int) -> str:
    """Return the name of a frame in events and reports."""
    return f"{log.log_id}/{timestamp}"


class Opened(NamedTuple):
    """The log of a part is open."""

    source: str  # `source_name` of the log
    num_frames: int  # of the part
    todo: tuple[str, ...]  # names of its incomplete frames


class Done(NamedTuple):
    """A frame is on disk. `seconds` by stage; "compute" is the time of its batch, divided by the number of frames."""

    name: str
    seconds: dict[str, float]


class Failed(NamedTuple):
    """A frame has no result, or a log cannot be opened."""

    name: str  # of the frame, or `source_name` of the log
    message: str


class Noted(NamedTuple):
    """Something that a user should know about a log, or about a worker."""

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

    def parts(self, sources: Sequence[Any], workers: int = 1) -> list[Part]:
        """Divide this shard's share of the logs into parts, enough of them for all workers.

        The sequence of all logs is divided into `count` shares of equal length. So a shard opens only its own logs, and
        shares at most the first and the last of them with a neighbour.
        """
        begin = self.index * len(sources)  # both edges count in 1 / count of a log
        end = begin + len(sources)
        logs = range(begin // self.count, -(-end // self.count))
        pieces = -(-_PARTS_PER_WORKER * workers // len(logs)) if logs and workers > 1 else 1
        parts: list[Part] = []
        for log in logs:
            first = max(begin - log * self.count, 0)
            last = min(end - log * self.count, self.count)
            edges = [first * pieces + (last - first) * k for k in range(pieces + 1)]
            for left, right in zip(edges, edges[1:]):
                parts.append(Part(sources[log], left, right, self.count * pieces))
        return parts


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
