"""Slow groups: motion of a pixel or less, which no count of pixels shows, proved on the centroids of small cubes.

What nothing moved so far may still creep: a pedestrian, a car that starts. Between two sweeps its pixels stay, but the
points within them shift, and sloping sides show it only where heights are told apart finely. Two steps keep that
cheap. Pixels tell which groups lean to a side: more of them meet something a pixel ahead than a pixel behind. Of those
alone cubes are made, and small shifts are judged by how well the centroids meet, against no shift.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.cubes import Cubes
from cflow_torch.verified.height_slices import Cells, count_slices
from cflow_torch.verified.moving import moving_points
from cflow_torch.verified.voxel_centroids import UNITS, make_voxels
from cflow_torch.windows.collation import Batch

# Tried on sets that no part of this was made for (docs/beyond.md).
_SIDES = ((0, 1), (1, -1), (1, 0), (1, 1))  # (dy, dx), a pixel ahead; the opposite is behind
_LEAN_Z = 3  # standard deviations of luck for a lean
_LEAST_LEAN = 10  # and it must be a 10th of the group's slices
_NUM_LAYERS = 16  # cubes are told apart by this many layers as high as a pixel is wide, then they repeat
_STEP = 51  # units (1/1024 m) between shifts that are judged
_REACH = 3  # steps
_Z = 4.0  # standard deviations of luck that a shift is granted
_LEAST_GAIN = 2  # 40ths of a perfect meeting that a shift must gain per cube
_LEAST_CUBES = 6


def slow_motion(
    batch: Batch, place: Tensor, cells: Cells, number: Tensor, group: Tensor, asked: Tensor, elapsed: Tensor
) -> Tensor:
    """The motion of slow groups in pairs of sweeps.

    Args:
        batch, place, number: as for `moving_points`.
        cells: finest images.
        group: (P,) int64, group of each occupied pixel, G = none.
        asked: (G,) bool, groups that did not move so far; False = it is not looked at.
        elapsed: (G,) float64, sweep intervals from t to t+1.

    Returns:
        (G, 2) float64, x and y, metres per sweep interval; 0 = no motion is proved.

    Convention:
        Shifts are whole steps within a square, in raster order; of equally proved ones the first. No shift proves
        nothing. Of a group that moves a part may stand still, such as a post beside a car: cubes in blocks of 0.4 m
        that lose by the shift are put aside, and the rest is judged again. The parabola through the gains beside the
        best shift adds half a step at most.

    Cost: eight look-ups a pixel of the groups asked; of those that lean, 103 times 25 for each cube.
    """
    asked = asked & leans(cells, group, asked)
    num_groups = len(asked)
    of_pixel = torch.where(F.pad(asked, (0, 1)).index_select(0, group), group, num_groups)
    side = cells.grid.pixel_size
    points = moving_points(batch, place, number, of_pixel, num_groups, side, _NUM_LAYERS)
    voxels = make_voxels(points, number, cells.pixel.numel(), cells.grid, cells.num_steps, _NUM_LAYERS)
    cubes = Cubes(voxels, torch.zeros((num_groups, 2), dtype=torch.int64, device=group.device))
    judged = (_REACH, _STEP, _Z, _LEAST_GAIN, _LEAST_CUBES)
    best, proved = cubes.best_shift(*judged)
    cubes.heed(best, proved)
    best, proved = cubes.best_shift(*judged)

    beside = torch.tensor(((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)), device=group.device) * _STEP
    middle, *sides = cubes.gains(best + beside[:, None])[0].unbind(1)
    vertex = torch.stack((_vertex(sides[0], middle, sides[1]), _vertex(sides[2], middle, sides[3])), 1)
    flow = (best + vertex * _STEP) / UNITS / elapsed[:, None]
    return flow.masked_fill(~proved[:, None], 0.0) + 0.0  # + 0.0 turns -0.0 into 0.0


def leans(cells: Cells, group: Tensor, asked: Tensor) -> Tensor:
    """Which groups meet more of the other sweep a pixel ahead than a pixel behind, or the other way round.

    Args:
        cells: of pairs; other steps are not looked at.
        group: (P,) int64, G = none.
        asked: (G,) bool; of the others the answer is False.

    Returns:
        (G,) bool: in one of four directions ahead and behind differ by (a - b)^2 >= z^2 (a + b) and by a 10th of the
        slices that the group has, where a slices are met ahead only and b behind only, both sweeps together: for t+1
        ahead is the opposite side.
    """
    num_groups = len(asked)
    is_asked = F.pad(asked, (0, 1)).index_select(0, group)
    pixel = flat_nonzero(is_asked & (cells.step < 2))
    window, step, row, col, own, of_pixel = (
        values.index_select(0, pixel)
        for values in (cells.window, cells.step, cells.row, cells.col, cells.slices, group)
    )
    sign = 2 * step - 1
    size = torch.zeros(num_groups, dtype=torch.int64, device=own.device).index_add_(
        0, of_pixel, count_slices(own).long()
    )
    answer = torch.zeros_like(asked)
    for dy, dx in _SIDES:
        ahead, behind = (
            own & cells.look_up(cells.place(window, 1 - step, row + way * dy, col + way * dx)) for way in (sign, -sign)
        )
        counts = (count_slices(ahead & ~behind).long() << 32) + count_slices(behind & ~ahead)
        sums = torch.zeros(num_groups, dtype=torch.int64, device=own.device).index_add_(0, of_pixel, counts)
        a, b = sums >> 32, sums & 0xFFFFFFFF
        answer |= ((a - b) * (a - b) >= _LEAN_Z**2 * (a + b)) & ((a - b).abs() * _LEAST_LEAN >= size) & (size > 0)
    return answer


def _vertex(low: Tensor, middle: Tensor, high: Tensor) -> Tensor:
    """(G,) float64, where the parabola through three gains, (G,) int64, one step apart, is largest."""
    curve = 2 * middle - low - high
    vertex = (high - low).double() / (2 * curve).clamp(min=1).double()
    return torch.where(curve > 0, vertex, torch.zeros_like(vertex)).clamp(-0.5, 0.5)
