"""Unmatched components: those of which another sweep has hardly any pixel, so they have appeared, or moved away."""

from __future__ import annotations

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


def components_of(components: Components, index: Tensor) -> Groups:
    """Group K pixels by their dilated component at the second finest scale; copies are in none.

    `index`, (K,) int64, are positions in the list of pixels.
    """
    scale = components.levels[-3:][0]
    num_originals = len(scale.of_item)
    return scale[index.clamp(max=num_originals - 1)].where(index < num_originals)


def sizes_of_unmatched(sweeps: HeightSlicedSweeps, pixels: Pixels, component: Groups, is_unmatched: Tensor) -> Tensor:
    """Return the size of the component of each of K pixels if it is unmatched, else 0, (K,) int64.

    Args:
        pixels: K pixels, all those of some sweeps.
        component: these pixels, grouped by component, or by component and sweep.
        is_unmatched: (K,) bool, `are_unmatched`.

    Convention: the size is the sum of the reach of the K pixels, because pixels with a larger reach have fewer
        neighbours. So a car has a similar size for a sparse sensor as for a dense one.
    """
    reach = sweeps.columns.reach_of(pixels)
    size, num_unmatched = component.sum(torch.stack((reach, reach * is_unmatched)).long())
    return component.spread(size * (_MATCHED * (size - num_unmatched) < size))
