"""Segment the ground without a map, for any mounting height, many sweeps at once.

Idea: (1) Near the vehicle, most flat spots lie on one plane. (2) We grid the heights above that plane and keep the
tenth percentile of each cell. (3) The ground is the highest surface of limited slope below these heights, because
objects on the ground are steeper. We fit the surface twice: first with slopes as steep as hills, then with gentle ones
about the smoothed result. (4) A point is ground if it lies at most a threshold above the surface.

All arithmetic is in whole millimetres, so the bits do not depend on the batch, the order of points or the device.
"""

from __future__ import annotations

from numbers import Real
from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.errors import import_optional
from cflow_torch.ground.plane import FARTHEST, CellHeights, Points, near_plane
from cflow_torch.ops.groups import Groups
from cflow_torch.ops.lower_surface import NO_HEIGHT, lower_surface
from cflow_torch.ops.threads import one_thread
from cflow_torch.tensors import choose_device, read_positions
from cflow_torch.types import Array, CFlowError, Sweep, Window, check_points

# None = do not look for ground; "auto" = "grid" where there is no mask.
GROUND_METHODS = (None, "auto", "grid", "patchwork")
THRESHOLD = 0.3  # metres above the surface; the rule of the Argoverse 2 raster

# Cells are powers of two of a millimetre, so floor division is a shift, also for negative numbers.
_CELL_BITS, _CELLS = 10, 256  # 1.024 m

_HIGHEST = 1 << 28  # heights are clamped to this, mm
# Of the points within 32 m and farther than half a metre from the ground, less than 1.5 % lie below it on four real
# drives and 15 simulated ones, but more than 97 % if z points down.
_NEAR, _FAR, _SHARE_BELOW, _FEWEST_BELOW = 32_000, 500, 0.8, 200
_MOST_POINTS = 30_000  # `has_ground` and `ground_side` take every second, third, ... point of larger sweeps
_PATCHWORK_HEIGHT = 1.723  # metres, height of the sensor above ground in Patchwork++'s default settings


def find_ground(points: Array, method: str = "grid", threshold: float = THRESHOLD, device: Any = "auto") -> Array:
    """Segment the ground points of one sweep.

    Args:
        points: (N, 3+) float, metres, array or tensor; z roughly up, origin on, in or above the vehicle, at any height
            (sensor frame or ego frame). Columns after z are ignored.
        method: "grid", for which "auto" is another name, or "patchwork" (Patchwork++, `pip install pypatchworkpp`).
        threshold: metres, "grid" only; points up to this height above the surface, and all points below it, are ground.
        device: "auto" = the device of a tensor, else a GPU if there is one, else the CPU. The result is the same.

    Returns:
        (N,) bool, True = ground. An array for an array, a tensor on the same device for a tensor.

    Convention:
        Two flat spots (2 m x 2 m) 4 m apart are a pair if the slope between them is at most 25 %. All False if there
        are fewer than 20 pairs within 32 m, or fewer than one for every six spots with 4 or more points. NaN, infinite
        points and those with |x| or |y| >= 131 m are not ground. The order of points, the other sweeps and shifts by
        whole millimetres in z do not change the result.

    Raises:
        CFlowError: wrong shape, dtype, method or threshold; Patchwork++ is not installed.

    Cost: see `find_ground_batch`.
    """
    return find_ground_batch([points], method, threshold, device)[0]


@one_thread()
def find_ground_batch(
    clouds: Sequence[Array], method: str = "grid", threshold: float = THRESHOLD, device: Any = "auto"
) -> list[Array]:
    """Segment the ground of several sweeps at once, each as `find_ground` does. Tensors must be on one device.

    Cost: two sorts of all points, and some 60 passes over 256 x 256 cells per sweep. 100,000 points take 20 ms on one
    CPU thread (docs/data.md).
    """
    if method not in GROUND_METHODS[1:]:
        raise CFlowError(f"method={method!r}: give one of {', '.join(map(repr, GROUND_METHODS[1:]))}")
    if isinstance(threshold, bool) or not isinstance(threshold, Real) or not 0 <= threshold < FARTHEST:
        raise CFlowError(f"threshold={threshold!r}: give metres above the ground, for example 0.3")
    if not clouds:
        return []
    positions, sweep = _stack(clouds, device)
    points = Points.of(positions, sweep, len(clouds))
    is_ground = (
        _patchwork(points, positions) if method == "patchwork" else _grid(points, round(float(threshold) * 1000))
    )
    masks = is_ground.split([cloud.shape[0] for cloud in clouds])
    return [
        mask.to(cloud.device) if isinstance(cloud, Tensor) else mask.cpu().numpy() for mask, cloud in zip(masks, clouds)
    ]


@one_thread()
def has_ground(cloud: Array) -> bool:
    """Test whether a sweep contains ground, in a third of the time of `find_ground`, from at most 30,000 points."""
    return bool(near_plane(_thinned(cloud)).is_there)


@one_thread()
def ground_side(cloud: Array) -> int:
    """Return 0 if a sweep has no ground, else the side of it on which points are: 1 = z points up, -1 = z points down.

    z points down if nearly all points more than half a metre from the ground are below it.
    """
    points = _thinned(cloud)
    plane = near_plane(points)
    height = plane.heights(points)
    is_near = points.is_active & (points.position[:2].abs() < _NEAR).all(0)
    num_below = int((is_near & (height < -_FAR)).sum())
    num_above = int((is_near & (height > _FAR)).sum())
    is_down = num_below >= max(_FEWEST_BELOW, _SHARE_BELOW * (num_below + num_above))
    return (-1 if is_down else 1) if bool(plane.is_there) else 0


def _thinned(cloud: Array) -> Points:
    """Return every k-th point of a sweep."""
    check_points(cloud, "points")
    step = max(1, -(-cloud.shape[0] // _MOST_POINTS))
    return Points.of(*_stack([cloud[::step]], "auto"), 1)


def _grid(points: Points, threshold: int) -> Tensor:
    """Segment the ground by the method "grid", (N,) bool. The threshold is in mm."""
    plane = near_plane(points)
    height = plane.heights(points).clamp_(-_HIGHEST, _HIGHEST)
    cell = points.cell(_CELL_BITS, _CELLS)
    cells = CellHeights.of(points, height, cell, _CELLS)
    surface = lower_surface(cells.low.masked_fill(cells.count == 0, NO_HEIGHT).int())
    is_low = height <= Groups(cell, surface.numel()).spread(surface.flatten()) + threshold
    return is_low.logical_and_(points.is_active).logical_and_(plane.is_there.index_select(0, points.sweep))


def _stack(clouds: Sequence[Array], device: Any) -> tuple[Tensor, Tensor]:
    """Return the positions of all clouds, (3, N) float64, and the cloud of each point, (N,) int64, on one device."""
    for number, cloud in enumerate(clouds):
        check_points(cloud, f"points of sweep {number}")
    sweeps = [Sweep(cloud) for cloud in clouds]
    chosen = choose_device([Window(sweep, sweep) for sweep in sweeps], device)
    count = torch.tensor([cloud.shape[0] for cloud in clouds], device=chosen)
    positions = read_positions(sweeps, chosen)
    of_point = torch.arange(len(clouds), device=chosen).repeat_interleave(count, output_size=positions.shape[1])
    return positions, of_point


def _patchwork(points: Points, positions: Tensor) -> Tensor:
    """Segment by Patchwork++, (N,) bool. We shift each cloud in z to the sensor height of its default settings."""
    pypatchworkpp = import_optional(
        "pypatchworkpp",
        "method='patchwork' needs Patchwork++ (extra ground): pip install pypatchworkpp, or method='grid'",
    )
    settings = pypatchworkpp.Parameters()
    settings.sensor_height = _PATCHWORK_HEIGHT
    settings.enable_RNR = False  # needs intensities
    settings.verbose = False
    plane = near_plane(points)
    is_ground = torch.zeros_like(points.is_active)
    for number in plane.is_there.nonzero()[:, 0]:  # the library takes one cloud at a time
        member = (points.is_active & (points.sweep == number)).nonzero()[:, 0]
        cloud = np.zeros((len(member), 4), np.float32)
        cloud[:, :3] = positions[:, member].cpu().numpy().T
        cloud[:, 2] -= int(plane.height[number]) / 1000 + _PATCHWORK_HEIGHT
        segmenter = pypatchworkpp.patchworkpp(settings)
        segmenter.estimateGround(cloud)
        found = torch.from_numpy(np.asarray(segmenter.getGroundIndices(), dtype=np.int64))
        is_ground[member[found.to(member.device)]] = True
    return is_ground
