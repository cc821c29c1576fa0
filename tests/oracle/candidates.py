"""Motion candidates of nodes: peaks of the correlation with each sweep, and the velocity of a fast object."""

from __future__ import annotations

from typing import Sequence

import numpy as np

from oracle.component_tree import Node
from oracle.dense import scene_flow_in_1view
from oracle.height_slices import COUNT, NUM_SLICES, SlicedSweeps, Vector, value_at
from oracle.pixels import search_radius

LARGEST_BOX = 1 << 12  # pixels: a node whose box is larger is correlated at a coarser scale


def propose(sweeps: SlicedSweeps, nodes: Sequence[Node]) -> tuple[list[list[Vector]], list[float]]:
    """What each node may have done, (y, x) finest pixels per interval, in the order in which ties are decided; and the
    NCC of each with the nearest sweep that has it.

    The peak of each sweep, then the velocity. (0, 0), which never wins, stands for a sweep that lacks the node.
    """
    candidates: list[list[Vector]] = []
    scores = []
    for node in nodes:
        images, block = draw(sweeps, node)
        peaks = [find_peak(sweeps, images, block, m) for m in range(1, len(images))]
        candidates.append([*(motion for motion, _ in peaks), node.velocity])
        scores.append(next(score for _, score in peaks if score is not None))
    return candidates, scores


def draw(sweeps: SlicedSweeps, node: Node) -> tuple[np.ndarray, int]:
    """Images (S, H, W) of the slices of a node, and the finest pixels a side of their pixels: those of its level; if
    its box is larger than `LARGEST_BOX` there, the finest ones at which it is not, or the coarsest. Coarse pixels have
    all slices."""
    sizes = sweeps.config.pixel_sizes
    for size in (*sizes[: node.level + 1][::-1], sizes[0]):
        block = round(size / sweeps.size)
        step, *at = (sweeps.pixels[node.members] // (1, block, block)).T
        row, col = (axis - axis.min() for axis in at)
        if (row.max() + 1) * (col.max() + 1) <= LARGEST_BOX:
            break
    images = np.zeros((len(sweeps.elapsed), row.max() + 1, col.max() + 1), dtype=int)
    images[step, row, col] = sweeps.slices[node.members] if block == 1 else (1 << NUM_SLICES) - 1
    return images, block


def find_peak(sweeps: SlicedSweeps, images: np.ndarray, block: int, m: int) -> tuple[Vector, float | None]:
    """Motion (y, x) of a node from sweep m to t+1, finest pixels per interval, and its NCC; None without pixels at m.

    Convention: a parabola through the counts of slices that the pixels of the node share gives the fraction of a pixel.
        A peak at no shift stays there.
    """
    if not images[m].any():
        return (0.0, 0.0), None
    radius = search_radius(sweeps.config, sweeps.seconds[m], sweeps.size * block)
    (dx, dy), score = scene_flow_in_1view(images[m] > 0, images[0] > 0, 1.0, radius)
    if dx == 0 and dy == 0:
        return (0.0, 0.0), score
    row, col = np.nonzero(images[m])

    def shared(y: float, x: float) -> int:
        return int(COUNT[images[m, row, col] & value_at(images[0], row + int(y), col + int(x))].sum())

    middle, k = shared(dy, dx), sweeps.elapsed[m]
    y = dy + vertex(shared(dy - 1, dx), middle, shared(dy + 1, dx))
    x = dx + vertex(shared(dy, dx - 1), middle, shared(dy, dx + 1))
    return (y * block / k, x * block / k), score


def vertex(low: float, middle: float, high: float) -> float:
    """Where the parabola through three counts, one step apart, is largest: at most half a step from the middle one."""
    curve = 2 * middle - low - high
    return min(max((high - low) / (2 * curve), -0.5), 0.5) if curve > 0 else 0.0
