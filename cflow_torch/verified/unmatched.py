"""Unmatched components: those of which another sweep has hardly any pixel, so they have appeared, or moved away."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cflow_torch.ops.groups import Groups
from cflow_torch.verified.columns import NUM_SLICES, Pixels
from cflow_torch.verified.component_tree import Components
from cflow_torch.verified.height_slices import HeightSlicedSweeps

_MATCHED = 8  # a component is unmatched if less than one in 8 of its pixels is matched


def are_unmatched(sweeps: HeightSlicedSweeps, pixels: Pixels, other: int | Tensor) -> Tensor:
    """Tell which of K pixels have a slice that the sweep of step `other` lacks within the reach, (K,) bool.

    The step is (K,) int64, or one for all.
    """
    around = sweeps.columns.look_up(pixels, other) >> NUM_SLICES
    return (pixels.slices & ~around) > 0


class Unmatched(NamedTuple):
    """The unmatched components of K pixels."""

    component: Groups  # the K pixels, grouped by unmatched component and sweep
    size: Tensor  # (K,) int64, of this component; 0 = none


def find_unmatched(
    sweeps: HeightSlicedSweeps,
    components: Components,
    index: Tensor,
    pixels: Pixels,
    is_unmatched: Tensor,
    num_scales: int,
) -> Unmatched:
    """Find the unmatched components of t, or of t and t+1.

    Args:
        components: of the pixels without those of copies.
        index: (K,) int64, positions in the list of pixels, all pixels of t, or those of t and t+1. Copies have no
            component.
        pixels: these pixels.
        is_unmatched: (K,) bool, `are_unmatched`.
        num_scales: 1 = dilated components of the second finest scale; 2 = where these are matched, those of the finest
            scale, because a barrier may touch a car.

    Convention: the size is the sum of the reach of the pixels of a sweep, because pixels with a larger reach have fewer
        neighbours. So a car has a similar size for a sparse sensor as for a dense one.
    """
    dilated = range(components.num_levels - 1)[-2:][:num_scales]
    levels = [components.of_level(level) for level in dilated]
    num_originals = len(components.plain.of_item)
    original = index.clamp(max=num_originals - 1)
    of_level = torch.stack([level.of_item.index_select(0, original) for level in levels])  # [L, K]
    none = 2 * components.count
    of_sweep = torch.where(index < num_originals, 2 * of_level + pixels.step, none)
    component = Groups(of_sweep.view(-1), none)
    reach = sweeps.columns.reach_of(pixels)
    size, unmatched = component.sum(torch.stack((reach, reach * is_unmatched)).long().repeat(1, len(levels)))
    size = component.spread(size * (_MATCHED * (size - unmatched) < size)).view_as(of_sweep)
    is_coarse = size[0] > 0
    size = torch.where(is_coarse, size[0], size[-1])
    chosen = torch.where(is_coarse, of_sweep[0], of_sweep[-1]).masked_fill_(size == 0, none)
    return Unmatched(Groups(chosen, none), size)
