"""Compare each sweep of a log with the next one: which are repeated, have few points, or do not fit those around?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cflow_torch.data.log import Log
from cflow_torch.diagnosis.inspection import repeats
from cflow_torch.diagnosis.stillness import LEAST_SHARE, MISPLACED, are_finite, share_in_place, structure_of
from cflow_torch.errors import CFlowError
from cflow_torch.types import as_numpy

_AROUND = 10  # sweeps on each side that tell a usual share, or number of points
_ALTERNATING = 8  # sweeps that tell whether two sensors alternate
_FEW = 0.5  # part of the usual number of points, below which a sweep has few


class Neighbours(NamedTuple):
    """What is found of the sweeps of a log, one by one, and of each with the one before it."""

    errors: dict[int, Exception]  # of the sweeps that cannot be read
    num_points: dict[int, int]  # number of the finite points of each other sweep
    repeated: list[int]  # indices of the sweeps that have the points of the sweep before
    shares: list[float]  # share of the static structure of each sweep that is in place in the next one; NaN = unknown

    @staticmethod
    def of(log: Log) -> Neighbours:
        """Compare all neighbouring sweeps of a log. Cost: 20 ms a sweep."""
        result = Neighbours({}, {}, [], [])
        last, last_structure = None, np.zeros((0, 3))
        for index in range(len(log)):
            sweep, structure = None, np.zeros((0, 3))
            try:
                sweep = log.sweep(index)
                structure = structure_of(sweep)
                result.num_points[index] = int(are_finite(as_numpy(sweep.points)).sum())
            except (CFlowError, OSError) as error:
                result.errors[index] = error
            if index:
                result.shares.append(share_in_place(last, last_structure, sweep, structure))
            if last is not None and sweep is not None and repeats(last, sweep):
                result.repeated.append(index)
            last, last_structure = sweep, structure
        return result

    @property
    def small(self) -> dict[int, int]:
        """The sweeps with few points, and how many those around each have."""
        counts = np.array(list(self.num_points.values()))
        around = [int(_median(counts[max(k - _AROUND, 0) : k + _AROUND + 1])) for k in range(len(counts))]
        known = zip(self.num_points.items(), around)
        return {index: usual for (index, number), usual in known if number < _FEW * usual}

    def misplaced(self, log: Log) -> list[tuple[int, int]]:
        """Return runs of sweeps, first and last, that fit neither the sweep before them nor that after, but these fit.

        At the ends of the log, one neighbour is enough. A run without a sweep, (k + 1, k), is a pair that does not fit.
        Cost: reads two sweeps of each run again.
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
                pc0, pc1 = log.sweep(first - 1), log.sweep(last + 1)
                if share_in_place(pc0, structure_of(pc0), pc1, structure_of(pc1)) < MISPLACED * usual[first - 1]:
                    continue
            if has_ends or last >= first:
                runs.append((first, last))
        return runs


def alternate(log: Log) -> bool:
    """Test whether sweeps fit the second next one, but none fits the next: those of two sensors, alternating.

    We compare up to eight sweeps. False if one of them cannot be read.
    """
    count = min(_ALTERNATING, len(log.timestamps))
    first = (len(log.timestamps) - count) // 2
    try:
        sweeps = [log.sweep(first + k) for k in range(count)]
    except (CFlowError, OSError):
        return False
    points = [structure_of(sweep) for sweep in sweeps]

    def shares(start: int, step: int, by: int) -> list[float]:
        pairs = ((k, k + by) for k in range(start, count - by, step))
        return [share_in_place(sweeps[a], points[a], sweeps[b], points[b]) for a, b in pairs]

    # Poses may be those of one of the sensors, so only its sweeps fit: those of even, or of odd numbers.
    second = max(min(shares(start, 2, 2), default=0.0) for start in (0, 1))
    return second >= LEAST_SHARE and max(shares(0, 1, 1)) < MISPLACED * second


def _median(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else 0.0
