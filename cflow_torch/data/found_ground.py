"""A log whose sweeps get a ground mask where they have none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from cflow_torch.data.log import ChangedLog, Log
from cflow_torch.types import Sweep
from cflow_torch.windows.ground import find_ground


class GroundFoundLog(ChangedLog):
    """Another log, with the ground of sweeps without a mask found from their points.

    Args:
        log: any log.
        method: as for `cflow_torch.windows.ground.find_ground`.

    Convention: a mask that the log has is kept.

    Cost: one call of `find_ground` per sweep that is read.
    """

    def __init__(self, log: Log, method: str = "grid") -> None:
        super().__init__(log)
        self.method = method

    def sweep(self, index: int) -> Sweep:
        """The log's sweep with a ground mask."""
        sweep = self.log.sweep(index)
        if sweep.is_ground is not None:
            return sweep
        is_ground: Any = find_ground(sweep.points, self.method)
        return replace(sweep, is_ground=is_ground)
