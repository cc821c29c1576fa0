"""Which share of the work is this process's: by settings, or by what SLURM and torchrun say."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, List, Mapping, Optional, Sequence, Tuple

from cflow_torch.fleet.job import Unit
from cflow_torch.types import CFlowError

AUTO = "auto"


@dataclass(frozen=True)
class Shard:
    """Share number `index`, 0 ... `count` - 1, of `count`."""

    index: int = 0
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1 or not 0 <= self.index < self.count:
            raise CFlowError(
                f"shard.index={self.index} of shard.count={self.count}: give a count of at least 1 and an "
                "index of 0 ... count - 1"
            )

    def units(self, sources: Sequence[Any]) -> List[Unit]:
        """This shard's part of the logs.

        The logs, one after the other, are one line that is cut into `count` pieces of equal length; so a shard opens
        its own logs only, and shares at most its first and its last with a neighbour.
        """
        begin, end = (Fraction(edge * len(sources), self.count) for edge in (self.index, self.index + 1))
        units: List[Unit] = []
        for number in range(int(begin), len(sources)):
            first, last = max(begin - number, Fraction(0)), min(end - number, Fraction(1))
            if first >= last:
                break
            units.append(Unit(len(units), sources[number], first, last))
        return units


def find_shard(index: Any, count: Any, environ: Mapping[str, str]) -> Shard:
    """The shard of this process.

    Args:
        index: from 0, or "auto".
        count: number of shards, or "auto".
        environ: environment variables. "auto" is torchrun's RANK and WORLD_SIZE, else the task of an `srun` step, times
            the task of a SLURM array, whichever there are; else the only shard.

    Raises:
        CFlowError: not numbers, out of range, an index without a count, a count that the environment contradicts.
    """
    found = from_environment(environ)
    if index == AUTO and count == AUTO:
        return Shard(*(found or (0, 1)))
    if count == AUTO:
        raise CFlowError(f"shard.index={index} of how many? give shard.count as well")
    wanted = _number("shard.count", count)
    if index != AUTO:
        return Shard(_number("shard.index", index), wanted)
    if wanted == 1 and found is None:
        return Shard()
    if found is None or found[1] != wanted:
        told = "tells no number of tasks" if found is None else f"tells of {found[1]} tasks"
        raise CFlowError(f"shard.count={wanted}, but the environment {told}: give shard.index as well")
    return Shard(*found)


def from_environment(environ: Mapping[str, str]) -> Optional[Tuple[int, int]]:
    """(index, count) that torchrun or SLURM gives this process; None if neither does.

    A SLURM batch script is no task of its step: only `srun` sets SLURM_STEP_NUM_TASKS, so that `--ntasks=8` without
    `srun` does not silently compute one eighth.
    """
    index, count, found = 0, 1, False
    if "SLURM_ARRAY_TASK_ID" in environ:
        lowest, step = _of(environ, "SLURM_ARRAY_TASK_MIN", 0), _of(environ, "SLURM_ARRAY_TASK_STEP", 1)
        index, found = (_of(environ, "SLURM_ARRAY_TASK_ID") - lowest) // step, True
        count = _of(environ, "SLURM_ARRAY_TASK_COUNT", index + 1)
        if count == 1 and _of(environ, "SLURM_ARRAY_TASK_ID") > 0:
            raise CFlowError(
                "this SLURM array has one task whose number is not 0: to redo one shard give shard.index and "
                "shard.count, to do everything shard.index=0 shard.count=1"
            )
        if not index < count:
            raise CFlowError(
                "the tasks of this SLURM array have numbers with gaps: give shard.index and shard.count, or a range"
            )
    for rank, tasks in (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_STEP_NUM_TASKS")):
        if rank in environ and tasks in environ:
            size = _of(environ, tasks)
            return index * size + _of(environ, rank), count * size
    return (index, count) if found else None


def _of(environ: Mapping[str, str], name: str, default: Optional[int] = None) -> int:
    text = environ.get(name)
    return default if text is None and default is not None else _number(name, text)


def _number(name: str, value: Any) -> int:
    try:
        return int(str(value))
    except ValueError:
        raise CFlowError(f"{name}={value!r}: give a whole number") from None
