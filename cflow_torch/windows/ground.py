"""Ground points without a map, for any mounting height, many sweeps at once.

Idea: (1) The ground near the vehicle is the height on which most flat spots lie, once the tilt is taken out: a plane.
(2) Heights above that plane fall into a grid; of each cell the lowest counts. (3) The ground is the highest surface of
limited slope below all of those: what stands on it is steeper. Done twice, first with slopes as steep as hills, then,
about the smoothed result, with gentle ones. (4) A point is ground if it lies less than a threshold above the surface.

All of it is arithmetic on whole millimetres: the same bits in any batch, in any order of the points, on any device.
"""

from __future__ import annotations

from typing import Any, Sequence

import numpy as np
import torch
from torch import Tensor

from cflow_torch.ops.lower_surface import UNKNOWN, lower_surface
from cflow_torch.ops.threads import one_thread
from cflow_torch.types import Array, CFlowError, Sweep, Window
from cflow_torch.windows.ground_plane import REACH, millimetres, near_plane, order_statistics
from cflow_torch.windows.validation import check_points, choose_device, read_positions

METHODS = ("grid", "patchwork")
THRESHOLD = 0.3  # metres above the surface; the rule of the Argoverse 2 raster

# A cell is a power of two of a millimetre: floor division is a shift, also of negative numbers.
_CELL_BITS, _CELLS = 10, 256  # 1.024 m

_HIGHEST = 1 << 28  # heights are cut off there, mm
_PATCHWORK_HEIGHT = 1.723  # metres, sensor height that Patchwork++'s other settings are made for


def find_ground(points: Array, method: str = "grid", threshold: float = THRESHOLD, device: Any = "auto") -> Array:
    """Ground points of one sweep.

    Args:
        points: (N, 3+) float, metres, array or tensor; z roughly up, origin on, in or above the vehicle, at any height
            (sensor frame or ego frame). Columns after z are ignored.
        method: "grid" or "patchwork" (Patchwork++, `pip install pypatchworkpp`).
        threshold: metres; points up to that far above the surface, and all points below it, are ground. "grid" only.
        device: "auto" = that of a tensor given, else a GPU if there is one, else the CPU; the result is the same.

    Returns:
        (N,) bool, True = ground; an array for an array, a tensor on the same device for a tensor.

    Convention:
        All False where there is no ground: fewer than 20 pairs of flat spots (2 m x 2 m) 4 m apart within 32 m.
        NaN and infinite points and points with |x| or |y| >= 131 m are not ground. Order of points, other sweeps of
        the batch and shifts by whole millimetres in z do not change the result.

    Raises:
        CFlowError: wrong shape, dtype, method or threshold; Patchwork++ is not installed.

    Cost: see `find_ground_batch`.
    """
    return find_ground_batch([points], method, threshold, device)[0]


@one_thread()
def find_ground_batch(
    clouds: Sequence[Array], method: str = "grid", threshold: float = THRESHOLD, device: Any = "auto"
) -> list[Array]:
    """Ground points of several sweeps at once; each result is that of `find_ground`.

    Args:
        clouds: B clouds, (N, 3+) each; tensors must lie on one device.
        method, threshold, device: as in `find_ground`.

    Returns:
        B masks, (N,) bool each, array or tensor as the cloud.

    Raises:
        CFlowError: as `find_ground`, or tensors on several devices.

    Cost: two sorts of all points, some 60 passes over 256 x 256 cells per sweep; 100,000 points take 20 ms on one CPU
    thread (docs/data.md).
    """
    if method not in METHODS:
        raise CFlowError(f"method={method!r}: give one of {', '.join(map(repr, METHODS))}")
    if isinstance(threshold, bool) or not isinstance(threshold, (int, float)) or not 0 <= threshold < REACH:
        raise CFlowError(f"threshold={threshold!r}: give metres above the ground, for example 0.3")
    if not clouds:
        return []
    positions, sweep = _stack(clouds, device)
    if method == "grid":
        is_ground = ground_points(positions, sweep, len(clouds), round(threshold * 1000))
    else:
        is_ground = _patchwork(positions, sweep, len(clouds))
    masks = is_ground.split([cloud.shape[0] for cloud in clouds])
    return [
        mask.to(cloud.device) if isinstance(cloud, Tensor) else mask.cpu().numpy() for mask, cloud in zip(masks, clouds)
    ]


@one_thread()
def has_ground(clouds: Sequence[Array], most_points: int = 30_000, device: Any = "auto") -> list[bool]:
    """Whether there is ground in each of several sweeps, from a part of their points.

    Args:
        clouds: B clouds, (N, 3+) each; tensors must lie on one device.
        most_points: of a cloud with more, every second, third, ... point is looked at.
        device: as in `find_ground`.

    Returns:
        B answers.

    Raises:
        CFlowError: wrong shape or dtype, tensors on several devices.

    Cost: the first third of `find_ground`, on at most `most_points` points a sweep.
    """
    if not clouds:
        return []
    for number, cloud in enumerate(clouds):
        check_points(cloud, f"points of sweep {number}")
    thinned = [cloud[:: max(1, -(-cloud.shape[0] // most_points))] for cloud in clouds]
    positions, sweep = _stack(thinned, device)
    points, inside = millimetres(positions)
    return list(near_plane(points, sweep, inside, len(clouds)).is_there.tolist())


def ground_points(positions: Tensor, sweep: Tensor, num_sweeps: int, threshold: int) -> Tensor:
    """Method "grid" on tensors.

    Args:
        positions: (3, N) float64, metres.
        sweep: (N,) int64, sweep of each point.
        num_sweeps: B.
        threshold: mm.

    Returns:
        (N,) bool.
    """
    points, inside = millimetres(positions)
    plane = near_plane(points, sweep, inside, num_sweeps)
    above = (points[2] - plane.at(points[0], points[1], sweep)).clamp_(-_HIGHEST, _HIGHEST)
    col, row = (points[:2] >> _CELL_BITS).add_(_CELLS // 2)
    cell = (sweep * _CELLS).add_(row).mul_(_CELLS).add_(col)
    num_cells = num_sweeps * _CELLS * _CELLS
    low, _, count = order_statistics(cell.masked_fill(~inside, num_cells), above, num_cells)
    low = low.masked_fill_(count == 0, UNKNOWN).int().view(num_sweeps, _CELLS, _CELLS)

    surface = lower_surface(low).flatten().index_select(0, cell)
    return (above <= surface + threshold).logical_and_(inside).logical_and_(plane.is_there.index_select(0, sweep))


def _stack(clouds: Sequence[Array], device: Any) -> tuple[Tensor, Tensor]:
    """(3, N) float64 positions of all clouds and (N,) int64 cloud of each, on one device."""
    for number, cloud in enumerate(clouds):
        check_points(cloud, f"points of sweep {number}")
    sweeps = [Sweep(cloud) for cloud in clouds]
    chosen = choose_device([Window(sweep, sweep) for sweep in sweeps], device)
    positions = [read_positions(sweep, chosen) for sweep in sweeps]
    together = positions[0] if len(positions) == 1 else torch.cat(positions, 1)
    count = torch.tensor([part.shape[1] for part in positions], device=chosen)
    of_point = torch.arange(len(clouds), device=chosen).repeat_interleave(count, output_size=together.shape[1])
    return together, of_point


def _patchwork(positions: Tensor, sweep: Tensor, num_sweeps: int) -> Tensor:
    """Method "patchwork": Patchwork++ with its own defaults, the cloud lifted to the sensor height that they suit."""
    try:
        import pypatchworkpp
    except ImportError:
        raise CFlowError("method='patchwork' needs Patchwork++: pip install pypatchworkpp, or method='grid'") from None
    points, inside = millimetres(positions)
    plane = near_plane(points, sweep, inside, num_sweeps)
    result = np.zeros(positions.shape[1], dtype=bool)
    for number in range(num_sweeps):  # a foreign library that takes one cloud at a time
        mine = (inside & (sweep == number)).cpu().numpy().nonzero()[0]
        if not bool(plane.is_there[number]):
            continue
        settings = pypatchworkpp.Parameters()
        settings.sensor_height = _PATCHWORK_HEIGHT
        settings.enable_RNR = False  # needs intensities
        settings.verbose = False
        cloud = np.zeros((len(mine), 4), np.float32)
        cloud[:, :3] = positions.cpu().numpy()[:, mine].T
        cloud[:, 2] -= int(plane.height[number]) / 1000 + _PATCHWORK_HEIGHT
        segmenter = pypatchworkpp.patchworkpp(settings)
        segmenter.estimateGround(cloud)
        result[mine[np.asarray(segmenter.getGroundIndices(), dtype=np.int64)]] = True
    return torch.from_numpy(result).to(positions.device)
