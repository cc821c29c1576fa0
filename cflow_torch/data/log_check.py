"""What is looked at when a log is opened: is its ground marked, does its static world stay put?"""

from __future__ import annotations

import warnings
from contextlib import suppress

from cflow_torch.data.log import Log
from cflow_torch.data.static_check import check_static_world
from cflow_torch.types import CFlowError
from cflow_torch.windows.ground import has_ground


class GroundWarning(UserWarning):
    """There are ground points in a log without ground masks."""


class SkewWarning(UserWarning):
    """Sweeps that the reader de-skews have no times of points."""


def check_log(log: Log) -> None:
    """Warn of mistakes that no sweep alone would show as an error.

    Args:
        log: any log. A sweep that cannot be read is passed over: it is reported when its turn comes.

    Warns:
        GroundWarning: the first sweep has ground points, but no mask that says so.
        SkewWarning: the first sweep should be de-skewed by the times of its points, and has none.
        StaticWorldWarning: see `check_static_world`.

    Cost: reads up to six sweeps; about 0.3 s.
    """
    for check in (_check_ground, _check_skew, check_static_world):
        with suppress(CFlowError, OSError):
            check(log)


def _check_ground(log: Log) -> None:
    sweep = log.sweep(0)
    if sweep.is_ground is None and has_ground([sweep.points])[0]:
        warnings.warn(
            f"log {log.log_id}: there are ground points, and no masks. The ground joins what stands on it into one "
            "cluster, so that moving objects are missed. Give data.find_ground=grid (in Python find_ground='grid'), or "
            "data.check=false if this is no ground",
            GroundWarning,
            stacklevel=2,
        )


def _check_skew(log: Log) -> None:
    if not getattr(log, "deskew", False):
        return
    sweep = log.sweep(0)
    if sweep.pose is not None and sweep.point_times is None:
        warnings.warn(
            f"log {log.log_id}: no times of points were found, so its sweeps are not de-skewed, and what stands still "
            "is smeared as the vehicle moves. If the clouds are compensated already, give data.deskew=false",
            SkewWarning,
            stacklevel=2,
        )
