"""Local evidence: what pixels that stand find in other sweeps where they are, and what a velocity wins and loses there.

A place that some sweep could not see says nothing: else shadows that pass over a wall would move it.
"""

from __future__ import annotations

from typing import NamedTuple, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.height_slices import NUM_SLICES, SLICE_HEIGHT, HeightSlicedSweeps, count_slices
from cflow_torch.verified.paired_test import looks, moves_of, way_of
from cflow_torch.verified.visibility import RangeImages


class Looks(NamedTuple):
    """L looks of pixels into other sweeps, as `looks` gives them, with what they find where the pixel stands.

    Args:
        pixel, other: (L,) int64.
        window, step, row, col: (L,) int64, of the pixel.
        own: (L,) uint8, slices of the pixel.
        found: (L,) uint8, those that the other sweep has where the pixel stands.
        here: (L,) uint8, those and what the other sweep cannot see there.
    """

    pixel: Tensor
    other: Tensor
    window: Tensor
    step: Tensor
    row: Tensor
    col: Tensor
    own: Tensor
    found: Tensor
    here: Tensor

    def take(self, which: Tensor) -> Looks:
        """Some of them, (K,) int64."""
        return Looks(*(values.index_select(0, which) for values in self))


def look(sweeps: HeightSlicedSweeps, members: Tensor) -> Looks:
    """What pixels, (K,) int64, find where they stand, in all sweeps that their window has."""
    pixel, other = looks(sweeps, members)
    window, step, row, col, own = (
        values.index_select(0, pixel) for values in (sweeps.window, sweeps.step, sweeps.row, sweeps.col, sweeps.slices)
    )
    found = own & sweeps.slices_at(window, other, row, col)
    has_other = sweeps.elapsed[window, step] != sweeps.elapsed[window, other]
    some = Looks(pixel, other, window, step, row, col, own, found, found).take(flat_nonzero(has_other))
    return some._replace(here=some.found | _hidden_slices(sweeps, some))


def try_all(sweeps: HeightSlicedSweeps, some: Looks, velocities: Tensor) -> Tuple[Tensor, Tensor]:
    """(L, V) uint8 each: slices that velocities, (V, 2) float64, (y, x) finest pixels per interval, win and lose in
    each look."""
    num_steps = sweeps.num_steps
    moves = moves_of(sweeps.elapsed, velocities.expand(sweeps.num_windows, -1, -1))
    which = some.window * (2 * num_steps) + way_of(some.step, some.other, num_steps)
    there = some.own[:, None] & sweeps.at_moved(sweeps.image, some.window, some.other, some.row, some.col, moves, which)
    return count_slices(there & ~some.here[:, None]), count_slices(some.found[:, None] & ~there)


def _hidden_slices(sweeps: HeightSlicedSweeps, some: Looks) -> Tensor:
    """(L,) uint8: slices of pixels that are not found where they stand, and that the other sweep cannot see there."""
    size, (lower_x, lower_y) = sweeps.grid.pixel_size, sweeps.grid.lower[:2]
    images, hidden, missing = RangeImages(sweeps), torch.zeros_like(some.own), some.own & ~some.found
    for index in range(NUM_SLICES):
        asked = flat_nonzero((missing & (1 << index)).bool())
        pixel, other, window, _, row, col = (values.index_select(0, asked) for values in some[:6])
        x, y = (col.double() + 0.5) * size + lower_x, (row.double() + 0.5) * size + lower_y
        # Of the heights that share this slice, the lowest that the pixel may have.
        first = torch.floor(sweeps.lowest.index_select(0, pixel) / SLICE_HEIGHT)
        z = (first + (index - first).remainder(NUM_SLICES) + 0.5) * SLICE_HEIGHT
        hidden[asked] |= images.hide(window, other, x, y, z).to(torch.uint8) << index
    return hidden
