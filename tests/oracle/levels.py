"""Components of the finest pixels at several pixel sizes."""

from __future__ import annotations

from typing import List, NamedTuple, Sequence

import numpy as np

from cflow_torch.config import Config
from oracle.clustering import cluster
from oracle.pixels import bounding_box


class Components(NamedTuple):
    """What a window looks like at one pixel size.

    Attributes:
        images: per sweep (H', W') uint8, slices of each coarse pixel.
        node: per sweep (H, W) int64, component of each occupied finest pixel; -1 elsewhere and where there is none.
        too_long: of each component, whether it is too long at t+1 to be an object.
    """

    images: List[np.ndarray]
    node: List[np.ndarray]
    too_long: List[bool]


def components_at(
    images: Sequence[np.ndarray], block: int, reach: int, pixel_size: float, max_object: float, config: Config
) -> Components:
    """Components at one pixel size.

    Args:
        images: (H, W) uint8 of sweep t+1, then of sweeps t, t-1, ...; bits are slices.
        block: k, finest pixels a side of a pixel of this size; those at the far ends may be cut off.
        reach: 3 = Alg. clustering, 1 = plain components.
        pixel_size: s of the finest pixels, metres.
        max_object: metres.
        config: `max_extent`, `connectivity`.
    """
    height, width = images[0].shape
    coarse = [np.zeros((-(-height // block), -(-width // block)), dtype=np.uint8) for _ in images]
    for fine, image in zip(images, coarse):
        for r, c in np.argwhere(fine).tolist():
            image[r // block, c // block] |= fine[r, c]
    labels = cluster([c > 0 for c in coarse], pixel_size * block, config.max_extent, config.connectivity, reach)
    node = [np.full((height, width), -1, dtype=np.int64) for _ in images]
    for fine, numbers in zip(images, node):
        for r, c in np.argwhere(fine).tolist():
            numbers[r, c] = labels[r // block, c // block]
    boxes = [bounding_box([np.argwhere(node[0] == i)]) for i in range(int(labels.max(initial=-1)) + 1)]
    return Components(coarse, node, [max(box[2], box[3]) * pixel_size > max_object for box in boxes])


def parents(node: Sequence[int], above: Sequence[int]) -> List[int]:
    """The component of the coarser level that holds each component.

    Args:
        node, above: component of each pixel at a level and at the next coarser one, -1 = none.

    Returns:
        Of each component, by its number: that of the first of its pixels that has one; -1 if none of them has.
    """
    result = [-1] * (max(node, default=-1) + 1)
    for child, parent in zip(node, above):
        if child >= 0 and result[child] < 0:
            result[child] = parent
    return result


def equals_parent(node: Sequence[int], above: Sequence[int]) -> List[bool]:
    """Of each component, whether it has the same pixels as its parent; arguments as for `parents`."""
    members = [{i for i, child in enumerate(node) if child == number} for number in range(max(node, default=-1) + 1)]
    return [
        parent >= 0 and own == {i for i, other in enumerate(above) if other == parent}
        for own, parent in zip(members, parents(node, above))
    ]
