"""Layers: what stands under something else, such as a car under the crown of a tree, shares its bird's-eye component.

In space the two are apart. Cells of what was found at rest are joined in three dimensions; a component that lies under
another one and above none is a lower layer. Lower layers are looked at once more, without what hangs above them.
"""

from __future__ import annotations

from typing import NamedTuple, Tuple

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.ops.labeling import union_find
from cflow_torch.ops.segments import segment_amin, segment_ends
from cflow_torch.verified.height_slices import SLICE_HEIGHT, HeightSlicedSweeps
from cflow_torch.verified.rigid_motion import TurningMotion, join
from cflow_torch.windows.collation import Batch

_CELL = 0.4  # metres, side of a cell; it is as high as a slice
_NUM_SLICES = 1 << 12  # from the lowest cell of a window on; what lies higher counts as one slice
_GROUND = 4.0  # metres: the lowest cell of the nine squares of this side around stands on the ground
_GAP = 3  # slices, at least, from a cell to the next one above it: less lies between the body of a car and its roof
# What moves on the ground, in slices: it begins at most this far above it, and is neither flat nor taller than a bus.
_HIGHEST_FOOT, _SMALLEST, _LARGEST = 2, 1, 10
# Half of the 26 neighbours, (down, right, up); the other half is the same links seen from the other side.
_HALF_NEIGHBOURS = [
    (down, right, up) for down in (0, 1) for right in (-1, 0, 1) for up in (-1, 0, 1) if (down, right, up) > (0, 0, 0)
]


class Cells(NamedTuple):
    """Occupied cells of all windows, all sweeps together, in ascending order.

    Args:
        key: (V,) int64, ((window * rows + row) * cols + col) * slices + slice.
        shape: rows, cols, slices.
        of_point: (N,) int64, cell of each point that was asked for.
    """

    key: Tensor
    shape: Tuple[int, int, int]
    of_point: Tensor


def points_at_rest(sweeps: HeightSlicedSweeps, found: TurningMotion) -> Tensor:
    """(N,) bool: points of all sweeps that take part and that nothing moved so far."""
    moves = (found.flow != 0).any(1) | (found.turn != 0)
    takes_part = sweeps.batch.takes_part & (sweeps.place < sweeps.image.numel() - 1)
    # By the pixel: points of t in the margin of the images have no result, but they may move.
    return takes_part & ~moves.index_select(0, found.of_place.index_select(0, sweeps.place))


def join_moving(first: TurningMotion, second: TurningMotion, batch: Batch) -> TurningMotion:
    """The first motion; for points that the second moves that one."""
    return join(first, second, (second.flow != 0).any(1).index_select(0, second.cluster(slice(None))), batch)


def points_of_lower_layers(sweeps: HeightSlicedSweeps, at_rest: Tensor) -> Tensor:
    """Which points at rest belong to something on the ground that lies under something else.

    Args:
        sweeps: finest images, for the region and the points.
        at_rest: (N,) bool, points that take part and stand still.

    Returns:
        (N,) bool.

    Convention:
        Cells of 0.4 m x 0.4 m x 0.5 m join with their 26 neighbours. A component lies under another one where that has
        the next occupied cell above it in any column, with two empty ones at least between them.

    Cost: linear in the points; 13 look-ups for each cell, a few rounds of union-find.
    """
    rows = flat_nonzero(at_rest)
    cells = _cells(sweeps, rows)
    component = _join(cells)
    count = cells.key.numel()
    column, height = split_index(cells.key, _NUM_SLICES)
    is_above = (height[1:] - height[:-1] >= _GAP) & (component[1:] != component[:-1])
    is_pair = flat_nonzero(is_above & (column[1:] == column[:-1]))
    is_under, is_over = (
        torch.zeros(count, dtype=torch.bool, device=rows.device).index_fill_(0, component.index_select(0, at), True)
        for at in (is_pair, is_pair + 1)
    )
    foot, top = segment_ends(height, component, count)
    rise = segment_amin(height - _ground(cells), component, count, _NUM_SLICES)
    is_object = (rise <= _HIGHEST_FOOT) & (top - foot >= _SMALLEST) & (top - foot <= _LARGEST)
    wanted = (is_under & ~is_over & is_object).index_select(0, component)
    return torch.zeros_like(at_rest).index_copy_(0, rows, wanted.index_select(0, cells.of_point))


def _cells(sweeps: HeightSlicedSweeps, rows: Tensor) -> Cells:
    """The cells of some points, (K,) int64 rows of the batch."""
    batch, grid = sweeps.batch, sweeps.grid
    num_rows, num_cols = (int((grid.upper[axis] - grid.lower[axis]) / _CELL) + 1 for axis in (1, 0))
    x, y, z = batch.positions.index_select(1, rows).unbind(0)
    window = divide(batch.image.index_select(0, rows).long(), batch.num_steps)
    size = torch.full((), _CELL, dtype=x.dtype, device=x.device)  # see `Grid.pixel`
    row, col = ((values - low).div_(size).long() for values, low in ((y, grid.lower[1]), (x, grid.lower[0])))
    height = (z / SLICE_HEIGHT).floor_().clamp_(-(2.0**40), 2.0**40).long()
    lowest = segment_amin(height, window, batch.num_windows, 1 << 41)
    height = (height - lowest.index_select(0, window)).clamp_(max=_NUM_SLICES - 1)
    key = ((window * num_rows + row) * num_cols + col) * _NUM_SLICES + height
    key, of_point = torch.unique(key, return_inverse=True)
    return Cells(key, (num_rows, num_cols, _NUM_SLICES), of_point)


def _join(cells: Cells) -> Tensor:
    """(V,) int64, component of each cell: its first cell."""
    num_rows, num_cols, num_slices = cells.shape
    count = cells.key.numel()
    column, height = split_index(cells.key, num_slices)
    line, col = split_index(column, num_cols)
    row = split_index(line, num_rows)[1]
    sources, targets = [], []
    for down, right, up in _HALF_NEIGHBOURS:
        inside = (row + down < num_rows) & (col + right >= 0) & (col + right < num_cols)
        inside &= (height + up >= 0) & (height + up < num_slices)
        key = cells.key + ((down * num_cols + right) * num_slices + up)
        at = torch.searchsorted(cells.key, key).clamp_(max=max(count - 1, 0))
        found = flat_nonzero(inside & (cells.key.index_select(0, at) == key))
        sources.append(found)
        targets.append(at.index_select(0, found))
    return union_find(count, torch.cat(sources), torch.cat(targets))


def _ground(cells: Cells) -> Tensor:
    """(V,) int64, slice of the ground around each cell: the lowest of the nine squares around."""
    num_rows, num_cols, num_slices = cells.shape
    side = round(_GROUND / _CELL)
    column, height = split_index(cells.key, num_slices)
    line, col = split_index(column, num_cols)
    window, row = split_index(line, num_rows)
    rows, cols = num_rows // side + 1, num_cols // side + 1
    square = (window * rows + divide(row, side)) * cols + divide(col, side)
    num_windows = int(window.amax()) + 1 if window.numel() else 0
    lowest = segment_amin(height, square, num_windows * rows * cols, num_slices).view(num_windows, 1, rows, cols)
    around = -F.max_pool2d(-F.pad(lowest, (1, 1, 1, 1), value=num_slices).float(), 3, 1)
    return around.view(-1).long().index_select(0, square)
