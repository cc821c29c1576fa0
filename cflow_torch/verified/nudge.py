"""Large moving groups: the motion is moved by 0.05 m at most, in x and in y, where centroids meet better beyond doubt.

Counts of pixels place a small group best: there are few centroids, and each is at the mercy of its sampling. A large
one has many, and they know more than the counts. Which is which the proof says: the gain must exceed luck by far.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.verified.cubes import Cubes
from cflow_torch.verified.moving import MovingPoints
from cflow_torch.verified.voxel_centroids import UNITS, make_voxels
from cflow_torch.windows.bev_grid import Grid

# Tried on sets that no part of this was made for (docs/beyond.md).
_STEP = 26  # units (1/1024 m) between shifts that are judged
_REACH = 2  # steps
_Z = 3.0  # standard deviations of luck that a shift is granted
_LEAST_GAIN = 1  # 40ths of a perfect meeting that a shift must gain per cube
_LEAST_CUBES = 400


def nudge(points: MovingPoints, number: Tensor, num_pixels: int, grid: Grid, elapsed: Tensor, flow: Tensor) -> Tensor:
    """The motion of groups in pairs of sweeps, moved where that is proved.

    Args:
        points: of the groups; those of t and t+1 matter.
        number: (Q,) int32 or int64, number of the occupied pixel at each place, as for `make_voxels`.
        num_pixels, grid: as for `make_voxels`.
        elapsed: (B, S) float64, sweep intervals from each sweep to t+1.
        flow: (G, 2) float64, (y, x), pixels per sweep interval.

    Returns:
        (G, 2) float64, the same. A group of few cubes, or whose centroids gain nothing, keeps its flow.

    Convention: the shift is added to the flow; it is judged around the nearest whole unit.

    Cost: 25 times 25 for each cube of the groups.
    """
    num_groups = len(flow)
    interval = torch.ones(num_groups, dtype=torch.float64, device=flow.device)
    interval.scatter_(0, points.group, elapsed[:, 1].index_select(0, points.window))
    unit = grid.pixel_size * UNITS
    start = torch.floor(flow.flip(1) * unit * interval[:, None] + 0.5).long()
    cubes = Cubes(make_voxels(points, number, num_pixels, grid, elapsed.shape[1]), start)
    shift, proved = cubes.best_shift(_REACH, _STEP, _Z, _LEAST_GAIN, _LEAST_CUBES)
    moved = flow + shift.flip(1) / unit / interval[:, None]
    return torch.where(proved[:, None], moved, flow)
