"""The aperture problem: a line that seems to slide along itself has most likely not moved.

Walls, hedges and guard rails are sampled by a sensor that moves, so their samples seem to move with it, along the
line. If t+1 sees something all along where the line was, or the older sweeps all along where it is, the line itself
has stayed: one end of it may come into sight or leave it. A car seen from its side is a line as well, but one of its
ends leaves the place where it was, the other comes to a new one.
"""

from __future__ import annotations

from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import divide, flat_nonzero, split_index
from cflow_torch.ops.segments import bounding_boxes
from cflow_torch.verified.height_slices import HeightSlicedSweeps

# A line: largest standard deviation across and smallest along, metres.
_THIN, _LONG = 0.3, 1.0
# Squared sine of the largest angle between a line and a motion along it.
_ALONG = 0.04
# Shorter ways than this, metres over the window, are left alone.
_LEAST_WAY = 1.2
# Side of the cells in which the other sweeps are looked at, metres, and the share that must hold something, per cent.
_CELL, _COVERED = 0.4, 88


def slides_along_itself(sweeps: HeightSlicedSweeps, owner: Tensor, candidates: Tensor) -> Tensor:
    """Which motions are explained by a line that stays where it is.

    Args:
        sweeps: finest images of all windows and their P occupied pixels.
        owner: (P,) int64, component of each occupied pixel, A = none of these.
        candidates: (A, C, 2) float64 (y, x), fine pixels per sweep interval.

    Returns:
        (A, C) bool: the component is a line at t+1, the motion points along it and leads at least 1.2 m over the
        window, and at least 88 % of looks find something at the same place: of those from its pixels at t+1 into every
        other sweep, or of those from its older pixels into t+1.

    Convention:
        Moments are sums of integers, everything else elementwise float64 in the written order. Standard deviations are
        those of the pixels' places, at most 0.3 m across and at least 1 m along. "The same place" is a cell of about
        0.4 m (whole pixels) and its eight neighbours. Zero motion never slides.

    Cost: some ten passes over the pixels; nine look-ups for each look of the few components that are suspect.
    Source: the aperture problem; not in the paper.
    """
    num_components = len(candidates)
    newest = flat_nonzero((owner < num_components) & (sweeps.step == 0))
    component, row, col = (values.index_select(0, newest) for values in (owner, sweeps.row, sweeps.col))
    is_line, axis_y, axis_x = principal_axes(component, row, col, num_components, sweeps.grid.pixel_size)

    # Its window, of each component; those without pixels at t+1 are no lines.
    window = torch.zeros_like(is_line, dtype=torch.int64).scatter_(0, component, sweeps.window.index_select(0, newest))
    intervals = (sweeps.elapsed.amax(1) - sweeps.elapsed.amin(1)).index_select(0, window)[:, None]
    y, x = candidates.unbind(2)
    across = axis_y[:, None] * x - axis_x[:, None] * y
    square = y * y + x * x
    length = (axis_y * axis_y + axis_x * axis_x)[:, None]
    suspect = is_line[:, None] & (across * across <= _ALONG * square * length)
    suspect &= square * (intervals * intervals) >= (_LEAST_WAY / sweeps.grid.pixel_size) ** 2
    looked_at = suspect.any(1)
    if not bool(looked_at.any()):
        return suspect
    return suspect & _is_covered(sweeps, owner, looked_at)[:, None]


def principal_axes(
    component: Tensor, row: Tensor, col: Tensor, num_components: int, pixel_size: float
) -> Tuple[Tensor, Tensor, Tensor]:
    """Whether each component is a line, (A,) bool, and y and x of its direction, (A,) float64, of any length.

    Args:
        component, row, col: (Q,) int64, its pixels at t+1.
        num_components: A.
        pixel_size: s, metres.
    """
    # Counted from the corner of its box, sums of squares stay exact.
    first, _ = bounding_boxes(row, col, component, num_components)
    y, x = row - first[:, 0].index_select(0, component), col - first[:, 1].index_select(0, component)
    n, sum_y, sum_x, sum_yy, sum_xx, sum_yx = (
        torch.zeros(num_components, dtype=torch.int64, device=row.device).index_add_(0, component, values).double()
        for values in (torch.ones_like(y), y, x, y * y, x * x, y * x)
    )
    n = n.clamp(min=1)
    var_y, var_x = (n * sum_yy - sum_y * sum_y) / (n * n), (n * sum_xx - sum_x * sum_x) / (n * n)
    cov = (n * sum_yx - sum_y * sum_x) / (n * n)
    # Eigenvalues of the 2 x 2 matrix; of the two ways to write the eigenvector, the one that does not vanish.
    mean, half = (var_y + var_x) / 2, (var_y - var_x) / 2
    root = torch.sqrt(half * half + cov * cov)
    small, large = mean - root, mean + root
    is_line = (small <= (_THIN / pixel_size) ** 2) & (large >= (_LONG / pixel_size) ** 2)
    is_wide = var_y < var_x
    return is_line, torch.where(is_wide, cov, large - var_x), torch.where(is_wide, large - var_y, cov)


def _is_covered(sweeps: HeightSlicedSweeps, owner: Tensor, looked_at: Tensor) -> Tensor:
    """(A,) bool: of the looks of a component forward or backward in time enough find something; of those that are not
    `looked_at`, (A,), it means nothing."""
    num_components, num_steps = looked_at.numel(), sweeps.num_steps
    side = max(1, round(_CELL / sweeps.grid.pixel_size))
    # A free margin all around: neighbours need no bounds check.
    height, width = -(-sweeps.grid.height // side) + 2, -(-sweeps.grid.width // side) + 2
    row, col = divide(sweeps.row, side) + 1, divide(sweeps.col, side) + 1
    in_image = torch.add(col, row, alpha=width)
    image = torch.add(sweeps.step, sweeps.window, alpha=num_steps)
    is_occupied = torch.zeros(sweeps.num_windows * num_steps * height * width, dtype=torch.bool, device=row.device)
    is_occupied.index_fill_(0, torch.add(in_image, image, alpha=height * width), True)

    members = flat_nonzero(torch.cat((looked_at, looked_at.new_zeros(1))).index_select(0, owner))
    window, step = sweeps.window.index_select(0, members), sweeps.step.index_select(0, members)
    # From t+1 into all other sweeps of the window, from those into t+1.
    given = (sweeps.elapsed != 0).index_select(0, window)
    others = torch.where((step == 0)[:, None], given, torch.arange(num_steps, device=row.device) == 0)
    looking, other = split_index(flat_nonzero(others), num_steps)
    where = in_image.index_select(0, members.index_select(0, looking))
    where += (window.index_select(0, looking) * num_steps + other) * (height * width)
    finds = torch.zeros_like(where, dtype=torch.bool)
    for offset in [down * width + right for down in (-1, 0, 1) for right in (-1, 0, 1)]:
        finds |= is_occupied.index_select(0, where + offset)
    way = owner.index_select(0, members.index_select(0, looking)) * 2 + (other == 0)
    looks, found = (
        torch.zeros(2 * num_components, dtype=torch.int64, device=row.device).index_add_(0, way, values)
        for values in (torch.ones_like(way), finds.long())
    )
    return ((looks > 0) & (found * 100 >= looks * _COVERED)).view(-1, 2).any(1)
