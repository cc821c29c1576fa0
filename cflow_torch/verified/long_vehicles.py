"""Trams and trains: what is longer than other vehicles moves only if both of its ends are seen to travel.

Walls, rails and hedges are as long, and their middle looks alike at nearly any shift. Where they seem to move, their
ends do not: one stands, or each goes where the sight of it ends. A rail may seem to keep pace with the vehicle at both
ends, since its few beams meet it at places that are fixed in the vehicle's frame; but no vehicle is as low as a rail.
"""

from __future__ import annotations

import math
from typing import Tuple

import torch
from torch import Tensor

from cflow_torch.ops.indices import flat_nonzero
from cflow_torch.verified.aperture import principal_axes
from cflow_torch.verified.height_slices import HeightSlicedSweeps, count_slices

# Ends that have gone less far, metres over the window, say nothing.
_LEAST_WAY = 1.2
# The ways of the two ends may differ by this share of their sum.
_ALIKE = 0.1
# Height slices in a pixel at t+1, on average: guard rails have one or, across a slice's border, two.
_TALL = 2


def ends_travel(sweeps: HeightSlicedSweeps, component: Tensor, is_long: Tensor) -> Tensor:
    """Which long components travel from end to end.

    Args:
        sweeps: finest images of all windows and their P occupied pixels.
        component: (P,) int64, component of each occupied pixel, M = none.
        is_long: (M,) bool, those that are asked about; each has pixels at t+1.

    Returns:
        (M,) bool: between the sweep that is farthest in time from t+1 and t+1 both ends have gone the same way along
        the component, at least 1.2 m, alike to a tenth of their sum; and its pixels at t+1 have two slices on average.
        False for all others.

    Convention:
        The component lies along the principal axis of its pixels at t+1; its ends in a sweep are the least and largest
        projection of its pixels there, elementwise float64 in the written order. Of sweeps equally far in time the
        first. A component without pixels in that sweep does not travel.

    Cost: some passes over the pixels of long components.
    Source: not in the paper.
    """
    count = is_long.numel()
    result = torch.zeros_like(is_long)
    member = flat_nonzero(torch.cat((is_long, is_long.new_zeros(1))).index_select(0, component))
    if member.numel() == 0:
        return result
    owner, window, step, row, col, slices = (
        values.index_select(0, member)
        for values in (component, sweeps.window, sweeps.step, sweeps.row, sweeps.col, sweeps.slices)
    )
    newest = flat_nonzero(step == 0)
    of_newest = owner.index_select(0, newest)
    _, axis_y, axis_x = principal_axes(
        of_newest, row.index_select(0, newest), col.index_select(0, newest), count, sweeps.grid.pixel_size
    )
    surplus = count_slices(slices.index_select(0, newest)).long() - _TALL
    is_tall = torch.zeros_like(is_long, dtype=torch.int64).index_add_(0, of_newest, surplus) >= 0

    place = row * axis_y.index_select(0, owner) + col * axis_x.index_select(0, owner)
    is_farthest = step == sweeps.elapsed.abs().argmax(1).index_select(0, window)
    (low, high), (low_then, high_then) = (
        _ends(place.index_select(0, some), owner.index_select(0, some), count)
        for some in (newest, flat_nonzero(is_farthest))
    )
    way_low, way_high = low - low_then, high - high_then  # infinite or NaN where one of them is not seen
    both, least = way_low + way_high, 2 * _LEAST_WAY / sweeps.grid.pixel_size
    is_far = both * both >= (least * least) * (axis_y * axis_y + axis_x * axis_x)
    return is_long & is_tall & is_far & ((way_low - way_high).abs() <= _ALIKE * both.abs())


def _ends(place: Tensor, owner: Tensor, count: int) -> Tuple[Tensor, Tensor]:
    """Least and largest of the places (K,) float64 of each component, (M,) float64; infinite where there are none."""
    infinite = place.new_full((count,), math.inf)
    return infinite.scatter_reduce(0, owner, place, "amin"), (-infinite).scatter_reduce(0, owner, place, "amax")
