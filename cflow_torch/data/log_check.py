"""Checks when a log is opened: is its ground masked, are its sweeps de-skewed, is its static world static?"""

from __future__ import annotations

import warnings
from contextlib import suppress

from cflow_torch.data.log import Log
from cflow_torch.data.static_check import check_static_world
from cflow_torch.types import CFlowError
from cflow_torch.windows.ground import has_ground


class GroundWarning(UserWarning):
    """A log has ground points but no ground masks."""


class SkewWarning(UserWarning):
    """A reader should de-skew sweeps that have no times of points."""


def check_log(log: Log) -> None:
    """Warn of mistakes that do not show as an error in any single sweep.

    Args:
        log: any log. A sweep that cannot be read is skipped here; reading it later raises the error.

    Warns:
        GroundWarning: the first sweep has ground points but no mask.
        SkewWarning: the first sweep should be de-skewed by the times of its points, but has none.
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
            f"log {log.log_id} has ground points but no ground masks. The ground connects all objects into one "
            "cluster, so moving objects are missed. Set data.find_ground=grid (in Python find_ground='grid'), or "
            "data.check=false if this is not ground",
            GroundWarning,
            stacklevel=2,
        )


def _check_skew(log: Log) -> None:
    if not getattr(log, "deskew", False):
        return
    sweep = log.sweep(0)
    if sweep.pose is not None and sweep.point_times is None:
        warnings.warn(
            f"log {log.log_id} has no times of points, so its sweeps are not de-skewed, and static objects are smeared "
            "while the vehicle moves. If the clouds are already compensated, set data.deskew=false",
            SkewWarning,
            stacklevel=2,
        )
