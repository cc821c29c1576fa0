"""What a writer of a format needs of a drive: all that its LiDARs, its odometry and its annotators saw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Optional, Protocol, Sequence

import numpy as np

from cflow_torch.data.log import FlowLabels
from cflow_torch.simulator.writers.av2 import Boxes
from cflow_torch.types import Sweep


@dataclass(frozen=True)
class UnitReturns:
    """What one LiDAR of the vehicle received in one sweep: N returns, shot by shot.

    Args:
        name: the unit's name in the data set, for example "LIDAR_TOP".
        T_ego_sensor: (4, 4) float64, coordinates of the unit to those of the ego frame.
        points: (N, 3) float32, metres, frame of the UNIT, after whatever motion compensation the data set does.
        ring: (N,) int32, row of the unit's table of elevations; row 0 is the lowest beam.
        column: (N,) int32, number of the azimuth step in the order of time.
        offset_ns: (N,) int64, time of the shot after the sweep's time stamp; may be negative.
        intensity: (N,) uint8.
        radial_velocity: (N,) float32, m/s, of the thing that was hit, over ground, along the ray; positive = receding.
        num_rings, num_columns: size of the unit's range image.
    """

    name: str
    T_ego_sensor: np.ndarray
    points: np.ndarray
    ring: np.ndarray
    column: np.ndarray
    offset_ns: np.ndarray
    intensity: np.ndarray
    radial_velocity: np.ndarray
    num_rings: int
    num_columns: int


class Recording(Protocol):
    """A drive as a writer sees it. It is a `Log` too."""

    log_id: str
    timestamps: Sequence[int]
    poses: np.ndarray
    """(num_sweeps, 4, 4) float64 `T_world_ego` at each time stamp."""

    def units(self, index: int) -> Sequence[UnitReturns]:
        """The LiDARs of sweep `index`. Their points, moved to the ego frame and put one after the other in this order,
        are the rows of `sweep(index)` and of `labels(index)`."""

    def elevations(self, unit: str) -> np.ndarray:
        """(num_rings,) float64 radians, elevation of each ring of a unit, lowest first."""

    def boxes(self, index: int) -> Boxes:
        """Annotation boxes of sweep `index`, ego frame, category by Argoverse 2 name."""

    def sweep(self, index: int) -> Sweep:
        """Points of all units in the ego frame, exact ground mask, pose, time."""

    def labels(self, index: int) -> Optional[FlowLabels]:
        """Exact truth of the pair (index, index + 1)."""
