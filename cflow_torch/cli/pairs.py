"""Which pairs of a log a command takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional

from omegaconf import DictConfig

from cflow_torch.cli.run import number
from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError


@dataclass(frozen=True)
class Pairs:
    """Every `step`-th pair of a log from `first` on, up to `count` of them (None: all)."""

    first: int = 0
    step: int = 1
    count: Optional[int] = None

    def of(self, log: Log) -> range:
        """Indices of the pairs of a log; none if it is shorter."""
        return range(self.first, len(log.timestamps) - 1, self.step)[: self.count]


def chosen_pairs(cfg: DictConfig, first: str, step: str, count: str = "") -> Pairs:
    """The pairs that settings choose.

    Args:
        cfg: resolved settings.
        first, step, count: their keys, in dotted form; "" if a command has no such setting.

    Raises:
        CFlowError: one of them is no whole number or too small.
    """
    given = {first: number(cfg, first), step: number(cfg, step)}
    if count:
        given[count] = number(cfg, count, or_null=True)
    limit = given.get(count)
    if given[first] < 0 or given[step] < 1 or (limit is not None and limit < 1):
        asked = ", ".join(f"{key}={value}" for key, value in given.items())
        raise CFlowError(
            f"{asked}: give a first pair of at least 0, a step {'and a count ' if count else ''}of at least 1"
        )
    return Pairs(given[first], given[step], limit)
