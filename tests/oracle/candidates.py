"""Motion candidates of nodes: peaks of the correlation with each sweep, their median, those of the nodes around."""

from __future__ import annotations

from statistics import median
from typing import Sequence

import numpy as np

from cflow_torch.config import VerifiedConfig
from oracle.component_tree import Node
from oracle.dense import scene_flow_in_1view
from oracle.height_slices import NUM_SLICES, Cell, Vector, count
from oracle.pixels import bounding_box, occupancy, search_radius

LARGEST_BOX = 1 << 12  # pixels: a node whose box is larger is correlated at a coarser scale


def propose(nodes: Sequence[Node], config: VerifiedConfig) -> tuple[list[list[Vector]], list[float]]:
    """What each node may have done, (y, x) finest pixels per interval, in the order in which ties are decided; and the
    NCC of each with the nearest sweep that has it.

    The median of the peaks of all sweeps in y and in x, if there is more than one other sweep; the peak of each; and
    the first candidates of the nodes around. (0, 0), which never wins, stands for a sweep that lacks the node.
    """
    candidates: list[list[Vector]] = []
    scores = []
    for node in nodes:
        peaks = [find_peak(node, m, config) for m in range(1, len(node.sweeps.images))]
        found = [motion for motion, score in peaks if score is not None]
        own = [motion for motion, _ in peaks]
        if len(own) > 1:
            own.insert(0, (median([y for y, _ in found]), median([x for _, x in found])))
        parent = node.parent
        while parent is not None:
            own.append(candidates[parent][0])
            parent = nodes[parent].parent
        candidates.append(own)
        scores.append(next(score for _, score in peaks if score is not None))
    return candidates, scores


def block_of(node: Node, config: VerifiedConfig) -> int:
    """Finest pixels a side of the pixels at which a node is correlated: those of its level; if its box is larger than
    `LARGEST_BOX` there, the finest ones at which it is not, or the coarsest."""
    blocks = [round(size / node.sweeps.size) for size in config.pixel_sizes[: node.level + 1]]
    for block in reversed(blocks):
        _, _, height, width = bounding_box([np.array([(r // block, c // block) for _, r, c in node.members])])
        if height * width <= LARGEST_BOX:
            return block
    return blocks[0]


def find_peak(node: Node, m: int, config: VerifiedConfig) -> tuple[Vector, float | None]:
    """Motion (y, x) of a node from sweep m to t+1, finest pixels per interval, and its NCC; None without pixels at m.

    Convention: a parabola through the counts of slices that the pixels of the node share gives the fraction of a pixel;
        coarse pixels have all slices. A peak at no shift stays there.
    """
    sweeps, block = node.sweeps, block_of(node, config)
    images: list[dict[Cell, int]] = [{} for _ in sweeps.images]
    for step, r, c in node.members:
        images[step][r // block, c // block] = sweeps.at(step, r, c) if block == 1 else (1 << NUM_SLICES) - 1
    if not images[m]:
        return (0.0, 0.0), None
    box = bounding_box([np.array(list(image)) for image in images if image])
    template, target = (occupancy(np.array(list(images[i])), box) for i in (m, 0))
    radius = search_radius(config, sweeps.seconds[m], sweeps.size * block)
    (dx, dy), score = scene_flow_in_1view(template, target, 1.0, radius)
    if dx == 0 and dy == 0:
        return (0.0, 0.0), score

    def shared(y: float, x: float) -> int:
        return sum(count(own & images[0].get((r + y, c + x), 0)) for (r, c), own in images[m].items())

    middle, k = shared(dy, dx), sweeps.elapsed[m]
    y = dy + vertex(shared(dy - 1, dx), middle, shared(dy + 1, dx))
    x = dx + vertex(shared(dy, dx - 1), middle, shared(dy, dx + 1))
    return (y * block / k, x * block / k), score


def vertex(low: float, middle: float, high: float) -> float:
    """Where the parabola through three counts, one step apart, is largest: at most half a step from the middle one."""
    curve = 2 * middle - low - high
    return min(max((high - low) / (2 * curve), -0.5), 0.5) if curve > 0 else 0.0
