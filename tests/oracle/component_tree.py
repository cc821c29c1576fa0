"""The component tree: components of the finest pixels at several pixel sizes, and which of them are objects."""

from __future__ import annotations

from typing import List, NamedTuple, Optional, Sequence, Tuple

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.clustering import cluster
from oracle.height_slices import Pixel, SlicedSweeps, coarsen
from oracle.long_vehicles import ends_travel


class Level(NamedTuple):
    """What a window looks like at one pixel size.

    Attributes:
        block: k, finest pixels a side of a pixel of this level; those at the far ends may be cut off.
        images: (H', W') uint8 of each sweep, slices of each coarse pixel.
        component: of each occupied finest pixel, -1 = none.
        members: of each component, its finest pixels.
        too_long: of each component, whether it is longer at t+1 than other objects, and is not seen to travel.
        travels: of each component, whether it is as long and both of its ends are seen to travel.
    """

    block: int
    images: List[np.ndarray]
    component: List[int]
    members: List[List[Pixel]]
    too_long: List[bool]
    travels: List[bool]


def find_components(sweeps: SlicedSweeps, block: int, is_undilated: bool, config: VerifiedConfig) -> Level:
    """Components at pixels of `block` x `block` finest ones: of Alg. clustering, or plain ones."""
    images, reach = [coarsen(image, block) for image in sweeps.images], 1 if is_undilated else 3
    labels = cluster(
        [i > 0 for i in images], sweeps.pixel_size * block, config.max_extent, config.connectivity, reach=reach
    )
    members: List[List[Pixel]] = [[] for _ in range(int(labels.max(initial=-1)) + 1)]
    component = []
    for m, r, c in sweeps.pixels():
        label = int(labels[r // block, c // block])
        component.append(label)
        if label >= 0:
            members[label].append((m, r, c))
    is_long = []
    for pixels in members:
        rows, cols = zip(*[(r, c) for m, r, c in pixels if m == 0])
        side = max(max(rows) - min(rows), max(cols) - min(cols)) + 1
        is_long.append(config.max_object is not None and side * sweeps.pixel_size > config.max_object)
    travels = [long and ends_travel(sweeps, pixels) for long, pixels in zip(is_long, members)]
    too_long = [long and not travel for long, travel in zip(is_long, travels)]
    return Level(block, images, component, members, too_long, travels)


def parents(component: Sequence[int], above: Sequence[int]) -> List[int]:
    """The component of the coarser level that holds each component.

    Args:
        component, above: component of each pixel at a level and at the next coarser one, -1 = none.

    Returns:
        Of each component, by its number: that of the first of its pixels that has one; -1 if none of them has.
    """
    result = [-1] * (max(component, default=-1) + 1)
    for part, whole in zip(component, above):
        if part >= 0 and result[part] < 0:
            result[part] = whole
    return result


def equals_parent(component: Sequence[int], above: Sequence[int]) -> List[bool]:
    """Of each component, whether it has the same pixels as its parent; arguments as for `parents`."""
    return [
        whole >= 0 and [one == part for one in component] == [one == whole for one in above]
        for part, whole in enumerate(parents(component, above))
    ]


def winners(levels: Sequence[Sequence[int]], evidence: Sequence[Sequence[int]]) -> List[Optional[Tuple[int, int]]]:
    """The component whose motion each pixel takes.

    Args:
        levels: coarse to fine: component of each pixel, -1 = none.
        evidence: of each component of each level, at least 0.

    Returns:
        Of each pixel (level, component): the coarsest of its components that has more evidence than its parts together;
        if there is none, its finest one; None if it has no finest one.

    Convention: the parts of a component are the components of the next finer level whose parent it is. Parts count with
        what their own parts sum up to, or with their own evidence if that is more.
    """
    finest = len(levels) - 1
    parent = [parents(level, above) for level, above in zip(levels[1:], levels)]  # of the components of level 1, 2, ...

    def sum_of_parts(level: int, component: int) -> int:
        if level == finest:
            return 0
        parts = [part for part, whole in enumerate(parent[level]) if whole == component]
        return sum(max(evidence[level + 1][part], sum_of_parts(level + 1, part)) for part in parts)

    result: List[Optional[Tuple[int, int]]] = []
    for components in zip(*levels):
        winner = None if components[finest] < 0 else (finest, components[finest])
        for level in reversed(range(finest)):
            component = components[level]
            if component >= 0 and evidence[level][component] > sum_of_parts(level, component):
                winner = level, component
        result.append(winner)
    return result
