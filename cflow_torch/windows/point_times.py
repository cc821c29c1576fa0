"""Times of points: seconds after the instant of their sweep, as users give them -> sweep intervals."""

from __future__ import annotations

from typing import Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.types import CFlowError, Sweep, Window

# No point of a sweep is measured further from its instant than this, seconds: other numbers are of another unit.
_LONGEST = 10.0
# Times are multiples of this part of a sweep interval: their sums are exact, in any order of the points.
_TICKS = 1 << 20


def has_point_times(window: Window, sources: Sequence[tuple[str, Sweep, int]]) -> bool:
    """Whether t+1 and every source sweep, before t+1 or after it, have them: one without would seem to be measured at
    other times."""
    return all(sweep.point_times is not None for sweep in (window.pc1, *(sweep for _, sweep, _ in sources)))


def read_point_times(sweep: Sweep, name: str, interval: float, device: torch.device) -> Tensor:
    """(N,) float64 sweep intervals, whole 2^-20.

    Args:
        sweep: one that has point times, of a shape that was checked.
        name: as users know it.
        interval: seconds from t to t+1.
        device: where they are to lie.

    Raises:
        CFlowError: a time is not finite, or too long to be a time within a sweep.
    """
    given = sweep.point_times
    times = given.detach() if isinstance(given, Tensor) else torch.from_numpy(np.array(given, dtype=np.float64))
    times = times.to(device, torch.float64)
    if not bool((times.abs() <= _LONGEST).all()):  # False for NaN
        raise CFlowError(
            f"point times of {name} are not all finite and within {_LONGEST:g} s of 0: give seconds after the sweep's "
            "time stamp (nanoseconds / 1e9; no time of day)"
        )
    return torch.floor(times / interval * _TICKS + 0.5) / _TICKS
