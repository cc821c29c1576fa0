"""A tree of components: the grouping that explains most wins.

A component at one pixel size holds parts at the next finer one. It may be one object whose parts are too small to be
followed, or several objects that move apart. Each has a worth: what its own best motion explains beyond doubt. If the
whole is worth more than its parts together, they take its motion; if not, each keeps its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import torch
from torch import Tensor

from cflow_torch.ops.segments import segment_amin
from cflow_torch.verified.levels import parents


@dataclass(frozen=True)
class Groups:
    """The components that won: what moves together. Numbered by window, then by their first pixel in the list.

    Args:
        of_pixel: (P,) int64, group of each occupied finest pixel, G = none.
        component: (G,) int64, which component it is, counted through all levels, coarse to fine: M_0 of the coarsest
            level, then M_1 of the next, ...
        first: (G,) int64, position of its first pixel in the list.
    """

    of_pixel: Tensor
    component: Tensor
    first: Tensor


def choose_groups(nodes: Sequence[Tensor], worths: Sequence[Tensor]) -> Groups:
    """Bottom up: a component wins where it is worth more than its parts together.

    Args:
        nodes: of each level, coarse to fine, (P,) int64: component of each occupied finest pixel, M = none.
        worths: of each level (M,) int64, worth of each component, at least 0; sums must stay below 2^63.

    Returns:
        The winners. A pixel belongs to the coarsest of its components that won; if none did, to its finest one. Pixels
        of no finest component (not linked between sweeps) go with a coarser one that wins.

    Convention:
        The whole must be worth more; at a draw the parts keep their own motion. Worth of a part that is no longer held
        by anything (see `parents`) is lost to what lies above.

    Cost: a few passes over the pixels per level; the only Python loop is over levels.
    """
    first_of_level = [0]
    for worth in worths:
        first_of_level.append(first_of_level[-1] + worth.numel())
    num_components = first_of_level[-1]

    node, value = nodes[-1], worths[-1]
    of_pixel = torch.where(node < value.numel(), node + first_of_level[-2], num_components)
    for above, worth, offset in reversed(list(zip(nodes[:-1], worths[:-1], first_of_level))):
        owner = parents(node, value.numel(), above, worth.numel())
        total = torch.zeros(worth.numel() + 1, dtype=torch.int64, device=worth.device).index_add_(0, owner, value)[:-1]
        wins = torch.cat((worth > total, torch.zeros(1, dtype=torch.bool, device=worth.device)))
        of_pixel = torch.where(wins.index_select(0, above), above + offset, of_pixel)
        node, value = above, torch.maximum(worth, total)

    position = torch.arange(of_pixel.numel(), device=of_pixel.device)
    first = segment_amin(position, of_pixel, num_components + 1, of_pixel.numel())[:num_components]
    first, component = first.sort()
    count = int((first < of_pixel.numel()).sum())
    first, component = first[:count], component[:count]
    number = torch.full((num_components + 1,), count, dtype=torch.int64, device=first.device)
    number.scatter_(0, component, torch.arange(count, device=first.device))
    return Groups(number.index_select(0, of_pixel), component, first)
