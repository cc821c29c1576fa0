"""Ground points without a map, for any mounting height, many sweeps at once.

Idea: (1) The ground near the vehicle is the height on which most flat spots lie, once the tilt is taken out: a plane.
(2) Heights above that plane fall into a grid; of each cell the lowest counts. (3) The ground is the highest surface of
limited slope below all of those: what stands on it is steeper. Done twice, first with slopes as steep as hills, then,
about the smoothed result, with gentle ones. (4) A point is ground if it lies less than a threshold above the surface.

All of it is arithmetic on whole millimetres: the same bits in any batch, in any order of the points, on any device.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, List, Sequence, Tuple

import numpy as np
import torch
from torch import Tensor

from cflow_torch.ops.lower_surface import UNKNOWN, lower_surface
from cflow_torch.types import Array, CFlowError, Sweep, Window
from cflow_torch.windows.validation import check_plain, choose_device, read_positions

METHODS = ("grid", "patchwork")
THRESHOLD = 0.3  # metres above the surface; the rule of the Argoverse 2 raster
REACH = 131.072  # metres; the grid covers |x|, |y| below it

# Cells are powers of two of a millimetre: floor division is a shift, also of negative numbers.
_CELL_BITS, _CELLS = 10, 256  # 1.024 m
_NEAR_BITS, _NEAR_CELLS = 11, 32  # 2.048 m, |x|, |y| < 32.768 m
_STEP, _STEP_BITS = 2, 12  # tilt is the median step of flat cells 4.096 m apart ...
_MAX_STEP = 1024  # ... of at most 25 %

_HIGHEST = 1 << 28  # heights are cut off there, mm
_FARTHEST_HEIGHT = 1e7  # metres; still fits the sort key
_TRIM = 10  # the lowest tenth of the points of a cell does not count: multipath
_FLAT, _FLAT_POINTS = 250, 4  # a near cell is flat if half of its points, at least 4 in all, lie in that layer, mm
_LAYER = 300  # flat cells of the ground differ by at most that (kerbs), mm
# There is ground if there are so many pairs of flat cells that are level enough, and a sixth as many as near cells.
# Simulated drives (seeds 400-409) have at least three times as many; with their ground removed at most a tenth.
_FEWEST_PAIRS, _SMALLEST_SHARE = 20, 6
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

    Warns:
        UserWarning: there are points, and all of them lie 131 m away or further.

    Raises:
        CFlowError: wrong shape, dtype, method or threshold; Patchwork++ is not installed.

    Cost: see `find_ground_batch`.
    """
    return find_ground_batch([points], method, threshold, device)[0]


def find_ground_batch(
    clouds: Sequence[Array], method: str = "grid", threshold: float = THRESHOLD, device: Any = "auto"
) -> List[Array]:
    """Ground points of several sweeps at once; each result is that of `find_ground`.

    Args:
        clouds: B clouds, (N, 3+) each; tensors must lie on one device.
        method, threshold, device: as in `find_ground`.

    Returns:
        B masks, (N,) bool each, array or tensor as the cloud.

    Raises:
        CFlowError: as `find_ground`, or tensors on several devices.

    Cost: two sorts of all points, some 60 passes over 256 x 256 cells per sweep; 100,000 points take 20 ms on one CPU
    thread (docs/ground.md).
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
    for number, mask in enumerate(masks):
        if not bool(mask.any()):
            _warn_if_far(positions[:, sweep == number], number)
    return [
        mask.to(cloud.device) if isinstance(cloud, Tensor) else mask.cpu().numpy() for mask, cloud in zip(masks, clouds)
    ]


def _warn_if_far(positions: Tensor, number: int) -> None:
    """(3, N) positions of a sweep, all of them too far from the origin to be looked at."""
    nearest = positions[:2].abs().amax(0).nan_to_num(torch.inf).amin() if positions.numel() else torch.zeros(())
    if REACH <= nearest < torch.inf:
        warnings.warn(
            f"no point of sweep {number} lies within {REACH:.0f} m of the origin, so no ground was found: give points "
            "in the frame of the vehicle or of the sensor",
            UserWarning,
            stacklevel=4,
        )


def has_ground(clouds: Sequence[Array], most_points: int = 30_000, device: Any = "auto") -> List[bool]:
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
        _check(cloud, number)
    thinned = [cloud[:: max(1, -(-cloud.shape[0] // most_points))] for cloud in clouds]
    positions, sweep = _stack(thinned, device)
    points, inside = _millimetres(positions)
    return list(near_plane(points, sweep, inside, len(clouds)).is_there.tolist())


@dataclass(frozen=True)
class Plane:
    """The ground near the vehicle, one plane per sweep.

    Args:
        is_there: (B,) bool, False = no ground was found; then the rest means nothing.
        step_x, step_y: (B,) int64, rise in mm per 4096 mm.
        height: (B,) int64, mm, at the origin.
    """

    is_there: Tensor
    step_x: Tensor
    step_y: Tensor
    height: Tensor

    def at(self, x: Tensor, y: Tensor, sweep: Tensor) -> Tensor:
        """(N,) int64 height in mm at x, y (N,) int64 mm."""
        rise = self.step_x.index_select(0, sweep).mul_(x).add_(self.step_y.index_select(0, sweep).mul_(y))
        return (rise >> _STEP_BITS).add_(self.height.index_select(0, sweep))


def near_plane(points: Tensor, sweep: Tensor, counts: Tensor, num_sweeps: int) -> Plane:
    """The plane on which most flat spots near the vehicle lie.

    Args:
        points: (3, N) int64, mm.
        sweep: (N,) int64, sweep of each point.
        counts: (N,) bool, False = leave the point out.
        num_sweeps: B.

    Convention: ties go to the lowest height.
    """
    size, num_cells = _NEAR_CELLS, num_sweeps * _NEAR_CELLS * _NEAR_CELLS
    col, row = (points[:2] >> _NEAR_BITS).add_(size // 2)
    is_near = (((col | row) & -size) == 0).logical_and_(counts)  # both in 0 ... size - 1
    cell = (sweep * size).add_(row).mul_(size).add_(col).masked_fill_(~is_near, num_cells)
    low, middle, count = (v.view(num_sweeps, size, size) for v in _order_statistics(cell, points[2], num_cells))
    is_seen = count >= _FLAT_POINTS
    is_flat = is_seen & (middle - low <= _FLAT)
    step_x, num_x = _median_step(low[:, :, :-_STEP], low[:, :, _STEP:], is_flat[:, :, :-_STEP] & is_flat[:, :, _STEP:])
    step_y, num_y = _median_step(low[:, :-_STEP], low[:, _STEP:], is_flat[:, :-_STEP] & is_flat[:, _STEP:])
    pairs = num_x + num_y
    is_there = (pairs >= _FEWEST_PAIRS) & (pairs * _SMALLEST_SHARE >= is_seen.flatten(1).sum(1))

    centre = ((torch.arange(size, device=low.device) - size // 2) << _NEAR_BITS) + (1 << (_NEAR_BITS - 1))
    rise = (step_x[:, None, None] * centre + step_y[:, None, None] * centre[:, None]) >> _STEP_BITS
    nothing = torch.iinfo(torch.int64).max // 2
    heights = (low - rise).masked_fill_(~is_flat, nothing).flatten(1).sort(1).values
    place = torch.arange(heights.shape[1], device=low.device)
    in_layer = torch.searchsorted(heights, heights + _LAYER, right=True) - place  # counted from each cell upwards
    in_layer.masked_fill_(heights == nothing, 0)
    most = in_layer.amax(1)
    first = torch.where(in_layer == most[:, None], place, heights.shape[1]).amin(1)
    height = heights.gather(1, (first + most // 2)[:, None].clamp_(max=heights.shape[1] - 1))[:, 0]
    return Plane(is_there, step_x, step_y, torch.where(is_there, height, 0))


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
    points, inside = _millimetres(positions)
    plane = near_plane(points, sweep, inside, num_sweeps)
    above = (points[2] - plane.at(points[0], points[1], sweep)).clamp_(-_HIGHEST, _HIGHEST)
    col, row = (points[:2] >> _CELL_BITS).add_(_CELLS // 2)
    cell = (sweep * _CELLS).add_(row).mul_(_CELLS).add_(col)
    num_cells = num_sweeps * _CELLS * _CELLS
    low, _, count = _order_statistics(cell.masked_fill(~inside, num_cells), above, num_cells)
    low = low.masked_fill_(count == 0, UNKNOWN).int().view(num_sweeps, _CELLS, _CELLS)

    surface = lower_surface(low).flatten().index_select(0, cell)
    return (above <= surface + threshold).logical_and_(inside).logical_and_(plane.is_there.index_select(0, sweep))


def _order_statistics(cell: Tensor, height: Tensor, num_cells: int) -> Tuple[Tensor, Tensor, Tensor]:
    """Low end (a tenth cut off), median and number of the heights of each cell.

    Args:
        cell: (N,) int64, 0 ... num_cells; those in cell num_cells are left out.
        height: (N,) int64, mm, |height| < 2^36.

    Returns:
        Three times (num_cells,) int64; the first two mean nothing where the number is 0.
    """
    offset, bits = 1 << 36, 37
    key = (cell << bits).add_(height).add_(offset).sort().values  # by cell, then by height
    count = torch.bincount(cell, minlength=num_cells + 1)[:-1]
    if key.numel() == 0:
        return torch.zeros_like(count), torch.zeros_like(count), count
    ordered = (key & ((1 << bits) - 1)).sub_(offset)
    start = count.cumsum(0).sub_(count)
    last = ordered.numel() - 1
    low, middle = (
        ordered.index_select(0, torch.div(count, part, rounding_mode="floor").add_(start).clamp_(max=last))
        for part in (_TRIM, 2)
    )
    return low, middle, count


def _median_step(here: Tensor, there: Tensor, is_pair: Tensor) -> Tuple[Tensor, Tensor]:
    """(B,) int64: median of there - here over the pairs that are no steeper than allowed; number of such pairs."""
    step = there - here
    counts = is_pair & (step.abs() <= _MAX_STEP)
    ordered = step.masked_fill(~counts, UNKNOWN).flatten(1).sort(1).values
    number = counts.flatten(1).sum(1)
    median = ordered.gather(1, (number // 2)[:, None].clamp_(max=ordered.shape[1] - 1))[:, 0]
    return torch.where(number > 0, median, 0), number


def _millimetres(positions: Tensor) -> Tuple[Tensor, Tensor]:
    """(3, N) int64 mm, and (N,) bool: the point is finite and on the grid; the others are moved to the origin."""
    x, y, z = positions.abs()
    # A millimetre inside: rounding must not lead off the grid.
    inside = (x < REACH - 0.001).logical_and_(y < REACH - 0.001).logical_and_(z < _FARTHEST_HEIGHT)
    return (positions * 1000).masked_fill_(~inside, 0).round_().long(), inside


def _stack(clouds: Sequence[Array], device: Any) -> Tuple[Tensor, Tensor]:
    """(3, N) float64 positions of all clouds and (N,) int64 cloud of each, on one device."""
    for number, cloud in enumerate(clouds):
        _check(cloud, number)
    sweeps = [Sweep(cloud) for cloud in clouds]
    chosen = choose_device([Window(sweep, sweep) for sweep in sweeps], device)
    positions = [read_positions(sweep, chosen) for sweep in sweeps]
    together = positions[0] if len(positions) == 1 else torch.cat(positions, 1)
    count = torch.tensor([part.shape[1] for part in positions], device=chosen)
    of_point = torch.arange(len(clouds), device=chosen).repeat_interleave(count, output_size=together.shape[1])
    return together, of_point


def _check(cloud: Any, number: int) -> None:
    check_plain(cloud, f"points of sweep {number}")
    if not isinstance(cloud, (np.ndarray, Tensor)) or cloud.ndim != 2 or cloud.shape[1] < 3:
        given = tuple(cloud.shape) if isinstance(cloud, (np.ndarray, Tensor)) else type(cloud).__name__
        raise CFlowError(f"points of sweep {number} are {given}: give an array or tensor of shape (N, 3+), metres")
    is_float = cloud.is_floating_point() if isinstance(cloud, Tensor) else np.issubdtype(cloud.dtype, np.floating)
    if not is_float:
        raise CFlowError(f"points of sweep {number} have dtype {cloud.dtype}: give floating-point metres")


def _patchwork(positions: Tensor, sweep: Tensor, num_sweeps: int) -> Tensor:
    """Method "patchwork": Patchwork++ with its own defaults, the cloud lifted to the sensor height that they suit."""
    try:
        import pypatchworkpp
    except ImportError:
        raise CFlowError("method='patchwork' needs Patchwork++: pip install pypatchworkpp, or method='grid'") from None
    points, inside = _millimetres(positions)
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
