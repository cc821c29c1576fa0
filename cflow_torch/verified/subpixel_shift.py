"""Sub-pixel shift of objects: the best of the whole-pixel shifts near their motion, and a parabola, all at once.

One grid of pixels cuts a small object badly by chance. Counts are therefore summed over grids that are moved by half a
pixel, in x, in y, and in both.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cflow_torch.ops.chunks import chunks
from cflow_torch.ops.parabola import vertex
from cflow_torch.verified.height_slices import NUM_SLICES, HeightSlicedSweeps
from cflow_torch.verified.voxel_centroids import ObjectPoints
from cflow_torch.windows.bev_grid import Grid

_GRIDS = 2  # by 2
_REACH = 1  # pixels, farthest shift from the given motion; counts are needed one pixel further
_SIDE = 2 * _REACH + 3  # shifts in y and in x that are counted


def shift_between_pixels(points: ObjectPoints, sweeps: HeightSlicedSweeps, flow: Tensor) -> Tensor:
    """The motion t -> t+1 of every object where most of its voxels at t meet one at t+1.

    Args:
        points: of the objects; those of t and t+1 matter.
        sweeps: finest images.
        flow: (G, 2) float64, (y, x), pixels per sweep interval.

    Returns:
        (G, 2) float64, the same. A object that meets nothing keeps its flow.

    Convention:
        The given motion is rounded to whole pixels, halves up. Of equal counts the shift nearest to it, of those the
        first in raster order. A voxel of t+1 counts whatever its object is. The parabola through the peak and its
        neighbours, in y and in x, adds half a pixel at most.

    Cost: for each of the four grids a sort of the points of t and 25 look-ups for each of their voxels; one table of a
        byte for each voxel of a sweep.
    """
    older, newest = (points.take(points.step == step) for step in (1, 0))
    start = torch.floor(flow + 0.5).long()
    grid = sweeps.grid  # grids that are moved need a pixel more
    height, width = grid.height + 1, grid.width + 1
    table = torch.zeros(sweeps.num_windows * height * width * NUM_SLICES + 1, dtype=torch.bool, device=flow.device)
    counts = torch.zeros((len(flow), _SIDE * _SIDE), dtype=torch.int64, device=flow.device)
    for phase in range(_GRIDS * _GRIDS):
        target = _voxel(newest, grid, phase)
        table.index_fill_(0, target, True)
        counts += _coincidences(_voxel(older, grid, phase), older.owner, table, start, height, width)
        table.index_fill_(0, target, False)
    return _peak(counts, start, flow)


def _voxel(points: ObjectPoints, grid: Grid, phase: int) -> Tensor:
    """(N,) int64, where in the table the voxel of each point is: window, row, col, slice in this order."""
    size = torch.full((), grid.pixel_size, dtype=torch.float64, device=points.position.device)
    (x, y), (x_0, y_0, _) = points.position.unbind(0), grid.lower
    col = torch.floor((x - x_0) / size + phase % _GRIDS / _GRIDS).long()
    row = torch.floor((y - y_0) / size + phase // _GRIDS / _GRIDS).long()
    pixel = (points.window * (grid.height + 1) + row) * (grid.width + 1) + col
    return pixel * NUM_SLICES + points.part


def _coincidences(voxel: Tensor, owner: Tensor, table: Tensor, start: Tensor, height: int, width: int) -> Tensor:
    """Voxels of each object that meet one of the table, at all shifts around the object's motion.

    Args:
        voxel, owner: (N,) int64, of points; a voxel counts once however many points it holds.
        table: (B * H * W * 4 + 1,) bool; the last entry is for what lies outside.
        start: (G, 2) int64, (dy, dx).

    Returns:
        (G, 25) int64.
    """
    num_objects, device = len(start), voxel.device
    key = torch.unique(voxel * num_objects + owner) if num_objects else voxel
    voxel = torch.div(key, max(num_objects, 1), rounding_mode="floor")
    owner = key - voxel * num_objects
    counts = torch.zeros(num_objects * _SIDE * _SIDE, dtype=torch.int64, device=device)
    offset = torch.arange(_SIDE, device=device)[:, None] - (_REACH + 1)
    for some in chunks(0, voxel.numel(), device, _SIDE * _SIDE):
        of_some, pixel, part = owner[some], voxel[some] >> 2, voxel[some] & (NUM_SLICES - 1)
        line = torch.div(pixel, width, rounding_mode="floor")
        window = torch.div(line, height, rounding_mode="floor")
        dy, dx = start.index_select(0, of_some).unbind(1)
        row = (line - window * height + dy + offset).repeat_interleave(_SIDE, 0)  # (25, N)
        col = (pixel - line * width + dx + offset).repeat(_SIDE, 1)
        inside = (row >= 0) & (row < height) & (col >= 0) & (col < width)
        place = ((window * height + row) * width + col) * NUM_SLICES + part
        meets = table.index_select(0, torch.where(inside, place, table.numel() - 1).view(-1))
        slot = torch.arange(_SIDE * _SIDE, device=device)[:, None] + of_some * (_SIDE * _SIDE)
        counts.index_add_(0, slot.view(-1), meets.long())
    return counts.view(num_objects, _SIDE * _SIDE)


def _peak(counts: Tensor, start: Tensor, flow: Tensor) -> Tensor:
    """(G, 2) float64: the start moved to the best of the inner shifts and on by the parabolas; the flow if all are 0.

    Args:
        counts: (G, 25) int64.
        start: (G, 2) int64.
        flow: (G, 2) float64.
    """
    offset = torch.arange(_SIDE * _SIDE, device=counts.device)
    dy, dx = torch.div(offset, _SIDE, rounding_mode="floor") - (_REACH + 1), offset % _SIDE - (_REACH + 1)
    is_inner = (torch.maximum(dy.abs(), dx.abs()) <= _REACH)[None]
    # Most, then nearest, then first: no two keys of a row are equal. A key holds two numbers below 32 and the count.
    key = ((counts << 10) + ((31 - dy * dy - dx * dx) << 5) + (31 - offset)).masked_fill(~is_inner, -1)
    best = 31 - (key.amax(1) & 31)
    middle = counts.gather(1, best[:, None])[:, 0]
    moves = [
        vertex(counts.gather(1, (best - step)[:, None])[:, 0], middle, counts.gather(1, (best + step)[:, None])[:, 0])
        for step in (_SIDE, 1)
    ]
    shift = torch.stack((dy.index_select(0, best) + moves[0], dx.index_select(0, best) + moves[1]), 1)
    return torch.where((middle > 0)[:, None], start + shift, flow)
