"""Motion candidates of nodes: peaks of the correlation with each sweep, their median, those of the nodes around."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.component_tree import Node
from oracle.dense import scene_flow_in_1view
from oracle.height_slices import NUM_SLICES, Cell, Vector, count, vertex
from oracle.history import median
from oracle.pixels import bounding_box, occupancy, search_radius

LARGEST_BOX = 1 << 12  # pixels: a node whose box is larger is correlated at a coarser scale


def propose(nodes: Sequence[Node], config: VerifiedConfig) -> tuple[list[list[Vector]], list[float]]:
    """What each node may have done, (y, x) finest pixels per interval, in the order in which ties are decided; and the
    NCC of each with the nearest sweep that has it."""
    own, scores = [], []
    for node in nodes:
        block = block_of(node, config)
        peaks = [find_peak(node, block, m, config) for m in range(1, len(node.sweeps.images))]
        own.append(list_motions([None if peak is None else peak[0] for peak in peaks], node.sweeps.elapsed[1:]))
        scores.append(next(peak[1] for peak in peaks if peak is not None))
    candidates = []
    for node, motions in zip(nodes, own):
        candidates.append(list(motions))
        while node.parent is not None:
            candidates[-1].append(own[node.parent][0])
            node = nodes[node.parent]
    return candidates, scores


def list_motions(estimates: Sequence[Vector | None], intervals: Sequence[float]) -> list[Vector]:
    """The median of all estimates in y and in x, if there is more than one sweep; each one by its intervals.

    Args:
        estimates: (y, x) displacement m -> t+1 for every other sweep m, nearest first; None = not known.
        intervals: k, sweep intervals from m to t+1.

    Returns:
        Motions per interval; (0, 0), which never wins, stands for what is not known.
    """
    per_interval = [None if f is None else (f[0] / k, f[1] / k) for f, k in zip(estimates, intervals)]
    found = [(0.0, 0.0) if f is None else f for f in per_interval]
    if len(estimates) > 1:
        known = [f for f in per_interval if f is not None]
        found.insert(0, (median([y for y, _ in known]), median([x for _, x in known])) if known else (0.0, 0.0))
    return found


def block_of(node: Node, config: VerifiedConfig) -> int:
    """Finest pixels a side of the pixels at which a node is correlated: those of its level; if its box is larger than
    `LARGEST_BOX` there, the finest ones at which it is not, or the coarsest."""
    blocks = [round(size / node.sweeps.size) for size in config.pixel_sizes]
    blocks = blocks[: node.level + 1]

    def area(block: int) -> int:
        _, _, height, width = bounding_box([np.array([(r // block, c // block) for _, r, c in node.members])])
        return height * width

    return next((block for block in reversed(blocks) if area(block) <= LARGEST_BOX), blocks[0])


def find_peak(node: Node, block: int, m: int, config: VerifiedConfig) -> tuple[Vector, float] | None:
    """Displacement (y, x) of a node from sweep m to t+1, finest pixels, and its NCC; None without pixels at m.

    Convention: a parabola through the counts of slices that the pixels of the node share gives the part of a pixel;
        coarse pixels have all slices. A peak at no shift stays there.
    """
    images: list[dict[Cell, int]] = [{} for _ in node.sweeps.images]
    for step, r, c in node.members:
        images[step][r // block, c // block] = node.sweeps.at(step, r, c) if block == 1 else (1 << NUM_SLICES) - 1
    if not images[m]:
        return None
    box = bounding_box([np.array(list(image)) for image in images if image])
    template, target = (occupancy(np.array(list(images[i])), box) for i in (m, 0))
    radius = search_radius(config, node.sweeps.seconds[m], node.sweeps.size * block)
    (dx, dy), score = scene_flow_in_1view(template, target, 1.0, radius)
    if dx == 0 and dy == 0:
        return (0.0, 0.0), score
    middle, above, below, left, right = (
        sum(count(own & images[0].get((r + down, c + aside), 0)) for (r, c), own in images[m].items())
        for down, aside in ((dy, dx), (dy - 1, dx), (dy + 1, dx), (dy, dx - 1), (dy, dx + 1))
    )
    return ((dy + vertex(above, middle, below)) * block, (dx + vertex(left, middle, right)) * block), score
