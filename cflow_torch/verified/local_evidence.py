"""Local evidence: what pixels that stand find in other sweeps where they are, and what a velocity wins and loses there.

A place that some sweep could not see says nothing: else shadows that pass over a wall would move it.
"""

from __future__ import annotations

from typing import NamedTuple, Tuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.height_slices import NUM_SLICES, SLICE_HEIGHT, HeightSlicedSweeps, count_slices
from cflow_torch.verified.paired_test import looks
from cflow_torch.verified.visibility import RangeImages


class Looks(NamedTuple):
    """L looks of pixels into other sweeps, as `looks` gives them, with what they find where the pixel stands.

    Args:
        pixel, other: (L,) int64.
        window, row, col: (L,) int64, of the pixel.
        k: (L,) float64, sweep intervals from the pixel's sweep to the other one.
        to_newest: (L,) float64, sweep intervals from the pixel's sweep to t+1.
        own: (L,) uint8, slices of the pixel.
        found: (L,) uint8, those that the other sweep has where the pixel stands.
        here: (L,) uint8, those and what the other sweep cannot see there.
    """

    pixel: Tensor
    other: Tensor
    window: Tensor
    row: Tensor
    col: Tensor
    k: Tensor
    to_newest: Tensor
    own: Tensor
    found: Tensor
    here: Tensor

    def take(self, which: Tensor) -> Looks:
        """Some of them, (K,) int64."""
        return Looks(*(values.index_select(0, which) for values in self))


def look(sweeps: HeightSlicedSweeps, members: Tensor) -> Looks:
    """What pixels, (K,) int64, find where they stand, in all sweeps that their window has."""
    pixel, other = looks(sweeps, members)
    window, step = (values.index_select(0, pixel) for values in (sweeps.window, sweeps.step))
    to_newest = sweeps.elapsed[window, step]
    k = to_newest - sweeps.elapsed[window, other]
    row, col, own = (values.index_select(0, pixel) for values in (sweeps.row, sweeps.col, sweeps.slices))
    found = own & sweeps.slices_at(window, other, row, col)
    some = Looks(pixel, other, window, row, col, k, to_newest, own, found, found).take(flat_nonzero(k != 0))
    return some._replace(here=some.found | _hidden_slices(sweeps, some))


def wins(sweeps: HeightSlicedSweeps, some: Looks, velocity: Tensor) -> Tuple[Tensor, Tensor]:
    """(L,) uint8 each: slices that a velocity, (2,) or (2, L) float64, wins and loses in each look."""
    down, right = (torch.floor(some.k * v + 0.5).long() for v in velocity)
    there = some.own & sweeps.slices_at(some.window, some.other, some.row + down, some.col + right)
    return count_slices(there & ~some.here), count_slices(some.found & ~there)


def at_newest(sweeps: HeightSlicedSweeps, some: Looks, velocity: Tensor) -> Tuple[Tensor, Tensor]:
    """(L,) int64 each: row and column where a velocity, (2,) float64, takes each pixel at t+1, kept in the image."""
    down, right = (torch.floor(some.to_newest * v + 0.5).long() for v in velocity)
    row, col = (some.row + down).clamp_(0, sweeps.grid.height - 1), (some.col + right).clamp_(0, sweeps.grid.width - 1)
    return row, col


def _hidden_slices(sweeps: HeightSlicedSweeps, some: Looks) -> Tensor:
    """(L,) uint8: slices of pixels that are not found where they stand, and that the other sweep cannot see there."""
    size, (lower_x, lower_y) = sweeps.grid.pixel_size, sweeps.grid.lower[:2]
    images, hidden, missing = RangeImages(sweeps), torch.zeros_like(some.own), some.own & ~some.found
    for index in range(NUM_SLICES):
        asked = flat_nonzero((missing & (1 << index)).bool())
        pixel, other, window, row, col = (values.index_select(0, asked) for values in some[:5])
        x, y = (col.double() + 0.5) * size + lower_x, (row.double() + 0.5) * size + lower_y
        # Of the heights that share this slice, the lowest that the pixel may have.
        first = torch.floor(sweeps.lowest.index_select(0, pixel) / SLICE_HEIGHT)
        z = (first + (index - first).remainder(NUM_SLICES) + 0.5) * SLICE_HEIGHT
        hidden[asked] |= images.hide(window, other, x, y, z).to(torch.uint8) << index
    return hidden
