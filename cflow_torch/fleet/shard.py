"""Which share of the work is this process's: by settings, or by what SLURM and torchrun say."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Any, List, Mapping, Optional, Sequence

from cflow_torch.fleet.job import Unit
from cflow_torch.fleet.machine import AUTO
from cflow_torch.types import CFlowError


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
        for number, source in enumerate(sources):
            first, last = max(begin - number, Fraction(0)), min(end - number, Fraction(1))
            if first < last:
                units.append(Unit(len(units), source, first, last))
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
    if index != AUTO and count == AUTO:
        raise CFlowError(f"shard.index={index} of how many? give shard.count as well")
    if index != AUTO:
        return Shard(_number("shard.index", index), _number("shard.count", count))
    found = _from_environment(environ)
    wanted = None if count == AUTO else _number("shard.count", count)
    if wanted not in (None, found.count if found else 1):
        told = f"tells of {found.count} tasks" if found else "tells no number of tasks"
        raise CFlowError(f"shard.count={wanted}, but the environment {told}: give shard.index as well")
    return found or Shard()


def _from_environment(environ: Mapping[str, str]) -> Optional[Shard]:
    """What torchrun or SLURM gives this process; None if neither does.

    A SLURM batch script is no task of its step: only `srun` sets SLURM_STEP_NUM_TASKS, so that `--ntasks=8` without
    `srun` does not silently compute one eighth.
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
