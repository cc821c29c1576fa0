"""A log whose sweeps get a ground mask where they have none."""

from __future__ import annotations

from typing import Any, Optional, Sequence

import numpy as np

from cflow_torch.data.hdf5.frames import StoredMotion
from cflow_torch.data.log import FlowLabels, Log
from cflow_torch.types import Sweep
from cflow_torch.windows.ground import find_ground


class GroundFoundLog:
    """Another log, with the ground of sweeps without a mask found from their points.

    Args:
        log: any log.
        method: as for `cflow_torch.windows.ground.find_ground`.

    Convention: a mask that the log has is kept. Everything else is the log's, `eval_mask` included.

    Cost: one call of `find_ground` per sweep that is read.
    """

    def __init__(self, log: Log, method: str = "grid") -> None:
        self.log, self.method = log, method
        self.log_id = log.log_id
        self.timestamps: Sequence[int] = log.timestamps

    def sweep(self, index: int) -> Sweep:
        """The log's sweep with a ground mask."""
        sweep = self.log.sweep(index)
        if sweep.is_ground is not None:
            return sweep
        is_ground: Any = find_ground(sweep.points, self.method)
        return Sweep(sweep.points, is_ground, sweep.pose, sweep.timestamp_ns)

    def labels(self, index: int) -> Optional[FlowLabels]:
        """The log's labels."""
        return self.log.labels(index)

    def eval_mask(self, index: int) -> Optional[np.ndarray]:
        """The log's evaluation mask, None where it has none."""
        mask = getattr(self.log, "eval_mask", None)
        return None if mask is None else mask(index)

    def stored_motion(self, index: int) -> Optional[StoredMotion]:
        """As `HDF5Log.stored_motion`, None where the log does not have it."""
        find = getattr(self.log, "stored_motion", None)
        return None if find is None else find(index)
