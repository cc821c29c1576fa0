"""Compare each sweep of a log with the next two: which are repeated, have few points, or do not fit those around?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.diagnosis.stillness import (
    LEAST_SHARE,
    MISPLACED,
    are_finite,
    share_in_place,
    share_of_sweeps,
    structure_of,
)
from cflow_torch.errors import CFlowError
from cflow_torch.types import Sweep, as_numpy

_AROUND = 10  # sweeps on each side that tell a usual share, or number of points
_FEW = 0.5  # part of the usual number of points, below which a sweep has few


class Neighbours(NamedTuple):
    """What is found of the sweeps of a log, one by one, and of each with those before it.

    A share is that of the static structure of a sweep that is in place in a later one; NaN = unknown.
    """

    errors: dict[int, Exception]  # of the sweeps that cannot be read
    num_points: dict[int, int]  # number of the finite points of each other sweep
    repeated: list[int]  # indices of the sweeps that have the points of the sweep before
    shares: list[float]  # of each sweep in the next one
    shares_of_second: list[float]  # of each sweep in the second next one

    @staticmethod
    def of(log: Log, indices: range) -> Neighbours:
        """Compare neighbouring sweeps of a log. Cost: 22 ms a sweep."""
        result = Neighbours({}, {}, [], [], [])
        before: list[tuple[Sweep | None, np.ndarray]] = []  # the last two sweeps, and their structure
        for index in indices:
            sweep, structure = None, np.zeros((0, 3))
            try:
                sweep = log.sweep(index)
                structure = structure_of(sweep)
                result.num_points[index] = int(are_finite(as_numpy(sweep.points)).sum())
            except (CFlowError, OSError) as error:
                result.errors[index] = error
            for shares, other in zip((result.shares, result.shares_of_second), before):
                shares.append(share_in_place(*other, sweep, structure))
            if before and before[0][0] is not None and sweep is not None and log.repeats(index):
                result.repeated.append(index)
            before = [(sweep, structure), *before[:1]]
        return result

    @property
    def alternate(self) -> bool:
        """Whether sweeps fit the second next one, but none fits the next: those of two sensors, alternating."""
        # Poses may be those of one of the sensors, so only its sweeps fit: those of even, or of odd numbers.
        second = max(min(self.shares_of_second[start::2], default=0.0) for start in (0, 1))
        return not self.errors and second >= LEAST_SHARE and max(self.shares) < MISPLACED * second

    @property
    def small(self) -> dict[int, int]:
        """The sweeps with few points, and how many those around each have, apart from those without any."""
        numbers = np.array(list(self.num_points.values()))
        counts = np.where(numbers > 0, numbers, np.nan)
        around = [int(_median(counts[max(k - _AROUND, 0) : k + _AROUND + 1])) for k in range(len(counts))]
        known = zip(self.num_points.items(), around)
        return {index: usual for (index, number), usual in known if number < _FEW * usual}

    def misplaced(self, log: Log) -> list[tuple[int, int]]:
        """Return runs of sweeps, first and last, that fit neither the sweep before them nor that after, but these fit.

        All sweeps of the log must be compared. At the ends of the log, one neighbour is enough. A run without a sweep,
        (k + 1, k), is a pair that does not fit. Cost: reads two sweeps of each longer run again.
        """
        shares = np.array(self.shares)
        usual = np.array([_median(shares[max(k - _AROUND, 0) : k + _AROUND + 1]) for k in range(len(shares))])
        with np.errstate(invalid="ignore"):
            is_low = (usual >= LEAST_SHARE) & (shares < MISPLACED * usual)
        is_low[list(log.gaps)] = False
        edges = np.flatnonzero(np.diff([False, True, *is_low, True, False])).reshape(-1, 2)
        runs = []
        for first, after in edges.tolist():  # the pairs of sweeps first - 1, ..., after - 1 are low
            last = after - 2
            has_ends = first > 0 and after <= len(shares)
            if has_ends and last >= first:
                share = self.shares_of_second[first - 1]
                if last > first:
                    share = share_of_sweeps(log.sweep(first - 1), log.sweep(last + 1))
                if share < MISPLACED * usual[first - 1]:
                    continue
            if has_ends or last >= first:
                runs.append((first, last))
        return runs


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0
